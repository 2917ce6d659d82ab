"""Eight rows at a time, as one row at a time: packing, and the states and relaxations of units."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from mn_onnx.extract.kernels import memory
from mn_onnx.extract.kernels.lanes import load_wide, pointer
from mn_onnx.extract.kernels.march import point_at_tables
from mn_onnx.extract.kernels.masks import count_before, load_integers, mask_of, pack_store
from mn_onnx.extract.kernels.settle import FIRST, settle_rows
from mn_onnx.extract.pack import pack
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

ROOMY = 64  # entries of a scratch region


@njit
def _pack(values, integers, bits, index, target, integer_target, before):
    pack_store(pointer(target), index, load_wide(pointer(values), np.int64(0)), mask_of(bits))
    pack_store(pointer(integer_target), index, load_integers(pointer(integers), np.int64(0)), mask_of(bits))
    pack_store(pointer(before), np.int64(0), count_before(bits, index), mask_of(np.int64(0xFF)))


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 255), st.integers(0, 8))
def test_lanes_are_packed_without_gaps(bits: int, index: int) -> None:
    values = np.random.default_rng(bits).normal(size=8)
    chosen = np.array([bool(bits >> lane & 1) for lane in range(8)])
    target, integers, before = np.full(24, np.nan), np.full(24, -1), np.zeros(8, np.int64)
    _pack(values, np.arange(8), bits, index, target, integers, before)
    np.testing.assert_array_equal(target[index : index + chosen.sum()], values[chosen])
    np.testing.assert_array_equal(integers[index : index + chosen.sum()], np.flatnonzero(chosen))
    assert np.isnan(target[:index]).all()
    assert np.isnan(target[index + 8 :]).all()
    np.testing.assert_array_equal(before, index + np.cumsum(chosen) - chosen)


@njit
def _settle(F, N, X, J, M, tables, system):
    rows = N[system + memory.SYS_ROWS]
    row_unit = system + memory.SYS_HEADER + N[system + memory.SYS_LEVELS] + 1
    return settle_rows(
        pointer(F), pointer(N), pointer(X), pointer(J), M, point_at_tables(tables), row_unit, row_unit + rows,
        system, rows, np.int64(0), rows, FIRST, np.int64(0),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 21), st.integers(0, 2**32 - 1))
def test_eight_rows_settle_as_single_ones(n_units: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    units = []
    for number in range(n_units):
        slopes = random.choice([0.0, 0.25, 1.0, -1.0], 2, replace=False)
        knot, value = random.choice([0.0, -0.5, 1.5]), random.choice([0.0, 0.75])
        table = KnotTable.exact([knot], [slopes], [value - slopes * knot])
        units.append(Unit(AffineRow(np.arange(3), random.normal(size=3), 0.1), (table,), f"unit {number}", table))
    output = AffineRow(np.arange(3, 3 + n_units), np.ones(n_units), 0.0)
    packed = pack(Network(3, tuple(units), output), -np.ones(3), np.ones(3))
    rows = packed.rows
    X = random.normal(size=memory.X_REGIONS * ROOMY)
    regions = X.reshape(-1, ROOMY)
    regions[memory.RADIUS] = np.abs(regions[memory.RADIUS]) * random.choice([0, 1], ROOMY)
    regions[memory.GROWTH] = regions[memory.RADIUS]
    regions[memory.HIGH] = regions[memory.LOW] + random.exponential(size=ROOMY)
    J = np.zeros((memory.J_REGIONS, ROOMY), np.int64)
    states = random.integers(0, 3, rows)
    J[memory.STATE_LOW, :rows], J[memory.STATE_HIGH, :rows] = states == 2, states != 0

    one_by_one = packed.F.copy()
    knots = slice(4 * rows, 5 * rows)
    one_by_one[knots] = np.nan  # which units of more knots have there
    found = []
    for F in (packed.F, one_by_one):
        x, j = X.copy(), J.reshape(-1).copy()
        counts = _settle(F, packed.N, x, j, ROOMY, packed.tables, 0)
        found.append((counts, x.reshape(-1, ROOMY), j.reshape(-1, ROOMY)))
    (eight, x8, j8), (single, x1, j1) = found
    assert eight == single
    for region in (memory.STATE_LOW, memory.STATE_HIGH, memory.KIND, memory.COL_KIND):
        np.testing.assert_array_equal(j8[region, :n_units], j1[region, :n_units])
    for region in (memory.READ_COLS, memory.READ_ROW, memory.READ_AT):
        np.testing.assert_array_equal(j8[region, : eight[2]], j1[region, : eight[2]])
    for region in (memory.SLOPE, memory.OFFSET, memory.ERROR):
        np.testing.assert_allclose(x8[region, :n_units], x1[region, :n_units], rtol=1e-9, atol=1e-12)
    for region in range(memory.OUTPUTS, memory.OUTPUTS + 5):
        np.testing.assert_allclose(x8[region, : eight[2]], x1[region, : eight[2]], rtol=1e-9, atol=1e-12)


SCRIPT = """
import mn_onnx
from numba.core.registry import cpu_target

assert "+avx512f" not in cpu_target.target_context.codegen().magic_tuple()[2]
surface = mn_onnx.extract({model!r}, threads=1)
print(surface.n_polygons, surface.n_vertices, surface.unmatched.size)
"""


def test_machines_without_wide_registers_find_the_same(tmp_path: Path) -> None:
    model = Path(__file__).parents[1] / "models" / "niq_fox.onnx"
    machine = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(model=str(model))],
        env=os.environ | machine,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["28316", "28314", "0"]
