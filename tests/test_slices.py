"""Bounds of the slices of a cell: those of the formulas, and they enclose the network."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from ir_networks import dense, naive_values, with_flat_units
from numba import njit
from numpy.typing import NDArray

from mn_onnx.extract.kernels.bound import bound_output, bound_units
from mn_onnx.extract.kernels.error_symbols import table_at, tracking_floats
from mn_onnx.extract.kernels.lanes import lane, pointer
from mn_onnx.extract.kernels.march import load_states, point_at_tables
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    J_REGIONS,
    LEVEL_SYMBOL,
    SYMBOL_ROW,
    SYS_COLS,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    X_REGIONS,
)
from mn_onnx.extract.kernels.slice_points import (
    ABOVE,
    POINT,
    POINT_COUNTS,
    POINTS,
    SLICE_FLOATS,
    SLICE_INTEGERS,
    SLICES,
    UNDER,
    place_points,
)
from mn_onnx.extract.kernels.slices import bound_slice_outputs, bound_symbols, missed_slices
from mn_onnx.extract.pack import Packed, pack
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import canonicalize
from oracle.random_networks import random_tables

Floats = NDArray[np.float64]
LOWER, UPPER = np.array([0.1, -0.3, 0.2]), np.array([0.3, -0.1, 0.4])
# Of numpy's: for constants of Python's, numba would compile the kernels once more.
M, ROOT_SYSTEM, YES, NO = np.int64(1024), np.int64(0), np.bool_(True), np.bool_(False)


class _Slices(NamedTuple):
    """Bounds of the slices of the root cell.

    ``bounds``: [8, 3], the range of the output's centre over each slice, and how far the output may be from it;
    ``slack``: the latter for the whole cell. ``missed``: bits of the slices that the surface misses; ``above``,
    ``under``: the same for every unit where it is settled, 0 where that is so on the whole cell. ``points`` [8, n, 3]:
    the vertices of the slices. ``centre`` [4], ``low``, ``thickness``: the planes between them.
    """

    bounds: Floats
    slack: float
    missed: int
    above: NDArray[np.int64]
    under: NDArray[np.int64]
    points: Floats
    centre: Floats
    low: float
    thickness: float

    def of(self, points: Floats) -> NDArray[np.int64]:
        """The slice of each of [n, 3] points."""
        values = points @ self.centre[:3] + self.centre[3]
        return np.clip((values - self.low) / self.thickness, 0, SLICES - 1).astype(np.int64)


@njit  # type: ignore[untyped-decorator]
def _bound(
    arrays: tuple[NDArray[Any], ...], tables: Any, root: int, scratch: int, bounds: Floats
) -> tuple[float, float, float, int, bool]:
    F, N, X = pointer(arrays[0]), pointer(arrays[1]), pointer(arrays[2])
    J, S, K = pointer(arrays[3]), pointer(arrays[4]), pointer(arrays[5])
    tables = point_at_tables(tables)
    rows, cols = N[SYS_ROWS], N[SYS_COLS]
    load_states(N, J, M, root, rows)
    _, _, _, radius = bound_units(F, N, X, J, M, tables, root, ROOT_SYSTEM, ROOT_SYSTEM, scratch, YES, NO)
    low, high, slack = bound_output(F, N, X, M, tables.extent, root, ROOT_SYSTEM, ROOT_SYSTEM, radius)
    thickness = (high - low) / SLICES
    placed = place_points(F, N, X, S, K, M, root, rows, low, thickness)
    # Whatever rows the cell settles, slices are given none of it.
    load_states(N, J, M, root, rows)
    errors, own, stride = table_at(scratch, rows, cols)
    bound_symbols(F, N, X, S, J, K, M, tables, ROOT_SYSTEM, ROOT_SYSTEM, errors, stride)
    lows, highs, slacks = bound_slice_outputs(F, N, X, S, J, K, M, tables.extent, ROOT_SYSTEM, errors, stride, own)
    for k in range(SLICES):
        bounds[k] = lane(lows, k), lane(highs, k), lane(slacks, k)
    missed = missed_slices(F, N, X, S, J, K, M, tables, ROOT_SYSTEM, ROOT_SYSTEM, errors, stride, own)
    return low, thickness, slack, missed, placed and radius >= 0.0


def _slices(packed: Packed) -> _Slices:
    F = np.concatenate([packed.F, np.full(8 + tracking_floats(packed.rows, packed.cols), np.nan)])
    X, J = np.zeros(X_REGIONS * M), np.zeros(J_REGIONS * M, np.int64)
    S, K = np.full(SLICE_FLOATS * M, np.nan), np.zeros(SLICE_INTEGERS * M, np.int64)
    bounds = np.zeros((SLICES, 3))
    arrays = F, packed.N, X, J, S, K
    low, thickness, slack, missed, bounded = _bound(arrays, packed.tables, packed.root, packed.F.size, bounds)
    assert bounded
    unit_of_row = packed.N[SYS_HEADER + packed.levels + 1 :][: packed.rows]
    above, under = np.zeros((2, unit_of_row.max() + 1), np.int64)
    symbols = np.arange(J[LEVEL_SYMBOL * M + packed.N[SYS_LEVELS]])
    units = unit_of_row[J[SYMBOL_ROW * M + symbols]]
    above[units], under[units] = K[ABOVE * M + symbols], K[UNDER * M + symbols]
    points = S[POINTS * M :][: POINT * K[POINT_COUNTS * M]].reshape(-1, 3, SLICES).transpose(2, 0, 1)
    centre = X[CENTRE_AT * M :][:4].copy()
    return _Slices(bounds, slack, missed, above, under, points, centre, low, thickness)


class _Symbol(NamedTuple):
    """An undecided ReLU over the cell: centre [4] and errors [symbols] of its pre-activation, its chord and error."""

    centre: Floats
    errors: Floats
    slope: float
    own: float


def _chord(low: float, high: float) -> tuple[float, float]:
    """Slope and error of a ReLU over a range; the error is its offset, too."""
    if low >= 0.0 or high <= 0.0:
        return float(low >= 0.0), 0.0
    slope = high / (high - low)
    return slope, -0.5 * slope * low


def _symbols(network: Network) -> tuple[list[_Symbol], Floats, Floats]:
    """The undecided units of dense layers of ReLU over the box; centre and errors of the output."""
    corners = np.array([[(LOWER, UPPER)[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)])
    centres, errors = np.eye(3 + len(network.units), 4), np.zeros((3 + len(network.units), len(network.units)))
    centres[3:] = 0.0
    symbols: list[_Symbol] = []
    for g, unit in enumerate(network.units):
        centre = unit.row.weights @ centres[unit.row.columns] + [0.0, 0.0, 0.0, unit.row.bias]
        error = unit.row.weights @ errors[unit.row.columns]
        values, radius = corners @ centre[:3] + centre[3], np.abs(error).sum()
        slope, own = _chord(values.min() - radius, values.max() + radius)
        centres[3 + g] = slope * centre + [0.0, 0.0, 0.0, own]
        errors[3 + g] = slope * error
        if own > 0.0:
            errors[3 + g, len(symbols)] = own
            symbols.append(_Symbol(centre, error, slope, own))
    output = network.output
    centre = output.weights @ centres[output.columns] + [0.0, 0.0, 0.0, output.bias]
    return symbols, centre, output.weights @ errors[output.columns]


def _bounds_by_formula(network: Network, points: Floats) -> Floats:
    """Range of the output's centre and its slack over the hull of [n, 3] points, a part of the box."""
    symbols, form, read = _symbols(network)
    forms, radii = np.zeros((len(read), 4)), np.zeros(len(read))
    chords = []
    for s, symbol in enumerate(symbols):
        row = symbol.centre + symbol.errors @ forms
        radius = np.abs(symbol.errors) @ radii
        values = points @ row[:3] + row[3]
        slope, own = _chord(values.min() - radius, values.max() + radius)
        onward, offset, error = np.array([slope - symbol.slope, own - symbol.own, own]) / symbol.own
        forms[s] = onward * row + [0.0, 0.0, 0.0, offset]
        radii[s] = abs(onward) * radius + error
        chords.append((onward, offset, error))
    slack = 0.0
    for s in range(len(symbols) - 1, -1, -1):
        onward, offset, error = chords[s]
        form = form + read[s] * (onward * symbols[s].centre + [0.0, 0.0, 0.0, offset])
        slack += abs(read[s]) * error
        read = read + read[s] * onward * symbols[s].errors
    values = points @ form[:3] + form[3]
    return np.array([values.min(), values.max(), slack])


NETWORKS = {
    "one knot": canonicalize(dense([12] * 5, seed=4), lower=LOWER, upper=UPPER).network,
    "levels of several sizes": canonicalize(dense([9, 5, 7, 6, 10, 8], seed=7), lower=LOWER, upper=UPPER).network,
    "flat outputs": canonicalize(with_flat_units([12] * 5, seed=4), lower=LOWER, upper=UPPER).network,
    "several knots and outputs": random_tables(3, (3, 3, 3, 2), n_knots=4, n_outputs=3),
}


@pytest.mark.parametrize("layers", [[12] * 5, [9, 5, 7, 6, 10, 8], [40, 33, 50, 7, 45, 41]], ids=str)
def test_slices_have_the_bounds_of_the_formulas(layers: list[int]) -> None:
    network = dense(layers, seed=4)
    found = _slices(pack(canonicalize(network, lower=LOWER, upper=UPPER).network, LOWER, UPPER))
    expected = np.array([_bounds_by_formula(network, points) for points in found.points])
    # Radii are enlarged by what float32 may have lost.
    assert found.bounds == pytest.approx(expected, abs=0.005 * found.slack)
    assert np.all(found.bounds[:, 2] > (1.0 - 1e-6) * expected[:, 2])
    assert found.bounds[:, 2].max() < 0.7 * found.slack


@pytest.mark.parametrize("name", NETWORKS)
def test_bounds_of_slices_enclose_output_and_units(name: str) -> None:
    network = NETWORKS[name]
    found = _slices(pack(network, LOWER, UPPER))
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (4000, 3))
    slice_of = found.of(points)
    low, high, slack = found.bounds[slice_of].T
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
            low, high, slack = found.bounds[k]
            assert (found.missed >> k & 1) == (low > slack or high < -slack)
            inside = f[found.of(points) == k]
            assert not (found.missed >> k & 1) or np.all(inside > 0.0) or np.all(inside < 0.0)
            seen.add(found.missed >> k & 1)
    assert seen == {0, 1}
