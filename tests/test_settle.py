"""Eight rows at a time, as one row at a time: packing, and the states and relaxations of units."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from mn_onnx.extract.kernels import memory
from mn_onnx.extract.kernels.lanes import load_wide, pointer
from mn_onnx.extract.kernels.march import point_at_tables
from mn_onnx.extract.kernels.masks import count_before, load_integers, mask_of, pack_store
from mn_onnx.extract.kernels.settle import AGAIN, FIRST, settle_rows
from mn_onnx.extract.pack import pack
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

ROOMY = 64  # entries of a scratch region
FIRST_LEVEL = 5  # units; fewer than the registers' eight


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
def _settle(F, N, X, J, M, tables, again):
    system = np.int64(0)
    rows = N[system + memory.SYS_ROWS]
    row_unit = system + memory.SYS_HEADER + N[system + memory.SYS_LEVELS] + 1
    return settle_rows(
        pointer(F), pointer(N), pointer(X), pointer(J), M, point_at_tables(tables), row_unit, row_unit + rows,
        system, rows, np.int64(0), rows, again, np.int64(0),
    )  # fmt: skip


def _random_unit(random: np.random.Generator, number: int, n_knots: int) -> Unit:
    """Units from `FIRST_LEVEL` on read unit 0."""
    knots = np.sort(random.choice([-0.5, 0.0, 0.25, 1.5], n_knots, replace=False))
    slopes = random.permutation([0.0, 0.25, 1.0, -1.0])[: n_knots + 1]
    intercepts = np.cumsum([random.choice([0.0, 0.75]), *(-np.diff(slopes) * knots)])
    table = KnotTable.exact(knots, slopes, intercepts)
    columns = np.arange(3) if number < FIRST_LEVEL else np.array([3])
    return Unit(AffineRow(columns, random.normal(size=columns.size), 0.1), (table,), f"unit {number}", table)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 21), st.integers(0, 2**32 - 1), st.booleans())
def test_eight_rows_settle_as_single_ones(n_units: int, seed: int, mixed: bool) -> None:
    """First on a cell, then on what is left of it; the second level's units may have more knots."""
    random = np.random.default_rng(seed)
    knots = [2 if mixed and number >= FIRST_LEVEL else 1 for number in range(n_units)]
    units = tuple(_random_unit(random, number, count) for number, count in enumerate(knots))
    output = AffineRow(np.arange(3, 3 + n_units), np.ones(n_units), 0.0)
    packed = pack(Network(3, units, output), -np.ones(3), np.ones(3))
    rows = packed.rows
    first = memory.SYS_HEADER + packed.levels + 1
    real = np.flatnonzero(packed.N[first : first + rows] >= 0)
    regions = random.normal(size=(memory.X_REGIONS, ROOMY))
    regions[memory.RADIUS] = np.abs(regions[memory.RADIUS]) * random.choice([0, 1], ROOMY)
    regions[memory.GROWTH] = regions[memory.RADIUS]
    J = np.zeros((memory.J_REGIONS, ROOMY), np.int64)
    last = packed.N[packed.root + memory.CELL_HEADER + rows :][:rows]
    J[memory.STATE_LOW, :rows], J[memory.STATE_HIGH, :rows] = random.integers(0, 2, rows) * last // 2, last
    middle = random.normal(size=ROOMY)

    one_by_one = packed.F.copy()
    one_by_one[4 * rows : 5 * rows] = np.nan  # which units of more knots have there
    settled = []
    for F in (packed.F, one_by_one):
        x, j = regions.reshape(-1).copy(), J.reshape(-1).copy()
        stages = []
        for again, reach in ((FIRST, 1.0), (AGAIN, 0.3)):
            x.reshape(-1, ROOMY)[memory.LOW], x.reshape(-1, ROOMY)[memory.HIGH] = middle - reach, middle + reach
            counts = _settle(F, packed.N, x, j, ROOMY, packed.tables, again)
            stages.append((counts, x.reshape(-1, ROOMY).copy(), j.reshape(-1, ROOMY).copy()))
        settled.append(stages)
    for (eight, x8, j8), (single, x1, j1) in zip(*settled, strict=True):
        assert eight == single
        for region in (memory.STATE_LOW, memory.STATE_HIGH, memory.KIND, memory.COL_KIND):
            rows_or_columns = real if region != memory.COL_KIND else slice(n_units)
            np.testing.assert_array_equal(j8[region, rows_or_columns], j1[region, rows_or_columns])
        for region in (memory.READ_COLS, memory.READ_ROW, memory.READ_AT):
            np.testing.assert_array_equal(j8[region, : eight[2]], j1[region, : eight[2]])
        for region in (memory.SLOPE, memory.OFFSET, memory.ERROR):
            np.testing.assert_allclose(x8[region, :n_units], x1[region, :n_units], rtol=1e-9, atol=1e-12)
        for region in range(memory.OUTPUTS, memory.OUTPUTS + 5):
            np.testing.assert_allclose(x8[region, : eight[2]], x1[region, : eight[2]], rtol=1e-9, atol=1e-12)
