"""Bounds of the slices of a cell: as if every slice were a cell of its own, and they enclose the network."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from ir_networks import dense, naive_values
from numba import njit
from numpy.typing import NDArray

from mn_onnx.extract.kernels.bound import bound_output, bound_units
from mn_onnx.extract.kernels.control import CONTROL_SIZE, TOP_F, TOP_I
from mn_onnx.extract.kernels.lanes import lane, pointer
from mn_onnx.extract.kernels.march import load_states, point_at_tables
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    J_REGIONS,
    SYS_HEADER,
    SYS_ROWS,
    TRIMMED_DEPTHS,
    X_REGIONS,
    first_trim_tag,
)
from mn_onnx.extract.kernels.shave import LOWER as LOWER_SIDE
from mn_onnx.extract.kernels.shave import UPPER as UPPER_SIDE
from mn_onnx.extract.kernels.shave import cut_off
from mn_onnx.extract.kernels.slice_points import (
    ABOVE,
    SLICE_FLOATS,
    SLICE_INTEGERS,
    SLICES,
    UNDER,
    place_points,
    plane_value,
)
from mn_onnx.extract.kernels.slices import bound_output as bound_slice_outputs
from mn_onnx.extract.kernels.slices import bound_rows, missed_slices
from mn_onnx.extract.pack import Packed, pack
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import canonicalize
from oracle.random_networks import random_tables

Floats = NDArray[np.float64]
LOWER, UPPER = np.array([0.1, -0.3, 0.2]), np.array([0.3, -0.1, 0.4])
# Of numpy's: for constants of Python's, numba would compile the kernels once more.
M, ROOT_SYSTEM, NO = np.int64(1024), np.int64(0), np.bool_(False)


Arrays = tuple[NDArray[Any], ...]


class _Slices(NamedTuple):
    """Bounds of the slices of the root cell.

    ``together``, ``alone``: [8, 3], the range of the output's centre over each slice, and how far the output may be
    from it; alone: with the slice as a cell. ``slack``: the same for the whole cell. ``missed``, ``above``, ``under``:
    bits of the slices that the surface misses, and for every unit in which it is settled. ``centre`` [4], ``low``,
    ``thickness``: the planes between slices.
    """

    together: Floats
    alone: Floats
    missed: int
    above: NDArray[np.int64]
    under: NDArray[np.int64]
    centre: Floats
    low: float
    thickness: float
    slack: float

    def of(self, points: Floats) -> NDArray[np.int64]:
        """The slice of each of [n, 3] points."""
        values = points @ self.centre[:3] + self.centre[3]
        return np.clip((values - self.low) / self.thickness, 0, SLICES - 1).astype(np.int64)


@njit  # type: ignore[untyped-decorator]
def _bound_cell(F: Any, N: Any, X: Any, J: Any, tables: Any, root: int, cell: int) -> tuple[float, float, float]:
    load_states(N, J, M, root, N[SYS_ROWS])
    bound_units(F, N, X, J, M, tables, cell, ROOT_SYSTEM, ROOT_SYSTEM, ROOT_SYSTEM, NO, NO)
    low, high, slack = bound_output(F, N, X, M, tables.extent, cell, ROOT_SYSTEM, ROOT_SYSTEM, -1.0)
    return low, high, slack


@njit  # type: ignore[untyped-decorator]
def _bound(
    arrays: Arrays, tables: Any, root: int, together: Floats, alone: Floats
) -> tuple[float, float, float, int, bool]:
    F, N, X = pointer(arrays[0]), pointer(arrays[1]), pointer(arrays[2])
    J, S, K = pointer(arrays[3]), pointer(arrays[4]), pointer(arrays[5])
    control, slot_of_tag = pointer(arrays[6]), pointer(arrays[7])
    tables = point_at_tables(tables)
    low, high, slack = _bound_cell(F, N, X, J, tables, root, root)
    thickness = (high - low) / SLICES
    rows, tag = N[SYS_ROWS], first_trim_tag(tables.n_knots)
    for k in range(SLICES):
        _bound_cell(F, N, X, J, tables, root, root)
        part, part_rows = root, rows
        if k > 0:
            limit = plane_value(low, thickness, k)
            part, part_rows = cut_off(F, N, X, J, M, control, slot_of_tag, part, part_rows, limit, UPPER_SIDE, tag, M)
        if k + 1 < SLICES:
            limit = plane_value(low, thickness, k + 1)
            part, part_rows = cut_off(F, N, X, J, M, control, slot_of_tag, part, part_rows, limit, LOWER_SIDE, tag, M)
        alone[k] = _bound_cell(F, N, X, J, tables, root, part)
    _bound_cell(F, N, X, J, tables, root, root)
    placed = place_points(F, N, X, S, K, M, root, rows, low, thickness)
    _bound_cell(F, N, X, J, tables, root, root)
    # Whatever rows the cell settles, slices are given none of it.
    load_states(N, J, M, root, N[SYS_ROWS])
    count = bound_rows(F, N, S, J, K, M, tables, ROOT_SYSTEM, ROOT_SYSTEM)
    lows, highs, slacks = bound_slice_outputs(F, N, S, K, M, tables.extent, ROOT_SYSTEM, ROOT_SYSTEM, count)
    for k in range(SLICES):
        together[k] = lane(lows, k), lane(highs, k), lane(slacks, k)
    missed = missed_slices(F, N, S, J, K, M, tables, ROOT_SYSTEM, ROOT_SYSTEM)
    return low, thickness, slack, missed, placed


def _slices(packed: Packed) -> _Slices:
    F = np.concatenate([packed.F, np.zeros(100_000)])
    N = np.concatenate([packed.N, np.zeros(100_000, np.int64)])
    control = np.zeros(CONTROL_SIZE, np.int64)
    control[TOP_F], control[TOP_I] = packed.F.size, packed.N.size
    X, J = np.zeros(X_REGIONS * M), np.zeros(J_REGIONS * M, np.int64)
    S, K = np.full(SLICE_FLOATS * M, np.nan), np.zeros(SLICE_INTEGERS * M, np.int64)
    slot_of_tag = np.zeros(first_trim_tag(packed.tables.n_knots) + 2 * TRIMMED_DEPTHS, np.int64)
    together, alone = np.zeros((SLICES, 3)), np.zeros((SLICES, 3))
    arrays = F, N, X, J, S, K, control, slot_of_tag
    low, thickness, slack, missed, placed = _bound(arrays, packed.tables, packed.root, together, alone)
    assert placed
    units = np.flatnonzero(packed.N[SYS_HEADER + packed.levels + 1 :][: packed.rows] >= 0)
    centre = X[CENTRE_AT * M :][:4].copy()
    return _Slices(together, alone, missed, K[ABOVE * M + units], K[UNDER * M + units], centre, low, thickness, slack)


NETWORKS = {
    "one knot": canonicalize(dense([12] * 5, seed=4), lower=LOWER, upper=UPPER).network,
    "levels of several sizes": canonicalize(dense([9, 5, 7, 6, 10, 8], seed=7), lower=LOWER, upper=UPPER).network,
    "several knots and outputs": random_tables(3, (3, 3, 3, 2), n_knots=4, n_outputs=3),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_slices_have_the_bounds_of_cells(name: str) -> None:
    found = _slices(pack(NETWORKS[name], LOWER, UPPER))
    assert found.together == pytest.approx(found.alone, rel=1e-9, abs=1e-12)
    assert found.together[:, 2].max() < found.slack


@pytest.mark.parametrize("name", NETWORKS)
def test_bounds_of_slices_enclose_output_and_units(name: str) -> None:
    network = NETWORKS[name]
    found = _slices(pack(network, LOWER, UPPER))
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (4000, 3))
    slice_of = found.of(points)
    low, high, slack = found.together[slice_of].T
    f = naive_values(network, points, tables=True)
    assert np.all(f >= low - slack)
    assert np.all(f <= high + slack)
    order = np.argsort(network.unit_level, kind="stable")
    for unit, above, under in zip(order, found.above, found.under, strict=True):
        row = Network(3, network.units[: int(unit)], network.units[unit].row)
        values = naive_values(row, points, tables=True)
        knot = network.units[unit].table.knots[0]
        assert np.all(values[(above >> slice_of) & 1 == 1] >= knot)
        assert np.all(values[(under >> slice_of) & 1 == 1] < knot)
    if name != "several knots and outputs":
        assert np.any(found.above)
        assert np.any(found.under)


def test_slices_are_missed_where_the_output_keeps_its_sign() -> None:
    network = NETWORKS["one knot"]
    points = np.random.default_rng(1).uniform(LOWER, UPPER, (4000, 3))
    seen = set()
    for level in np.quantile(naive_values(network, points, tables=True), [0.0, 0.1, 0.5, 0.9, 1.0]):
        shifted = replace(network, output=replace(network.output, bias=network.output.bias - level))
        found = _slices(pack(shifted, LOWER, UPPER))
        f = naive_values(shifted, points, tables=True)
        for k in range(SLICES):
            low, high, slack = found.together[k]
            assert (found.missed >> k & 1) == (low > slack or high < -slack)
            inside = f[found.of(points) == k]
            assert not (found.missed >> k & 1) or np.all(inside > 0.0) or np.all(inside < 0.0)
            seen.add(found.missed >> k & 1)
    assert seen == {0, 1}
