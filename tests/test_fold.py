"""Folded systems: the same function on the cell, whatever the arenas held before, and no weight where none is said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ir_networks import dense, naive_values
from numba import njit
from numpy.typing import NDArray

from mn_onnx.extract.kernels import memory
from mn_onnx.extract.kernels.bound import bound_units
from mn_onnx.extract.kernels.error_symbols import tracking_floats
from mn_onnx.extract.kernels.fold import fold, folding_floats
from mn_onnx.extract.kernels.lanes import pointer
from mn_onnx.extract.kernels.layout import carry_states
from mn_onnx.extract.kernels.march import load_states, point_at_tables
from mn_onnx.extract.kernels.memory import J_REGIONS, LINEAR, UNSTABLE, X_REGIONS
from mn_onnx.extract.pack import pack
from mn_onnx.ir.network import AffineRow, Network, Unit
from mn_onnx.ir.passes import canonicalize
from oracle.random_networks import random_tables

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
LOWER, UPPER = np.array([0.1, -0.3, 0.2]), np.array([0.4, 0.0, 0.5])
TRACKED = np.bool_(True)  # numpy's: for a constant of Python's, numba would compile the kernels once more


@njit
def _bound_and_fold(F, N, X, J, tables, cell, system, floats, folded, folded_floats, least, large):
    """Fold a system by bounds on the cell, whose states are in N if it is the first, else in J."""
    M = X.size // X_REGIONS
    f, n, x, j, knots = pointer(F), pointer(N), pointer(X), pointer(J), point_at_tables(tables)
    if system == 0:
        load_states(n, j, M, cell, N[memory.SYS_ROWS])
    bounds = bound_units(f, n, x, j, M, knots, cell, system, floats, folded_floats, TRACKED, large)
    fold(f, n, x, j, M, system, floats, folded, folded_floats, least)
    carry_states(n, j, M, knots, system, folded, least)
    return bounds[:3]


def _fold(
    network: Network, least: int, large: bool, lower: Floats = LOWER, upper: Floats = UPPER
) -> tuple[Floats, Integers, tuple[int, int, bool]]:
    """The folded system's floats and integers; all memory it could have used was NaN, or nonsense."""
    F, N, _, _, _, start_f, start_n, bounds = _fold_in_place(network, least, large, lower, upper)
    return F[start_f:], N[start_n:], bounds


def _fold_in_place(network: Network, least: int, large: bool, lower: Floats, upper: Floats) -> tuple[Any, ...]:
    """The arrays of a worker after folding, the packed network, where the folded system is in F and N, and bounds."""
    packed = pack(network, lower, upper)
    room = -(-(max(packed.rows, memory.symbol_stride(packed.cols)) + 8) // 8) * 8
    X, J = np.full(X_REGIONS * room, np.nan), np.full(J_REGIONS * room, 1 << 40)
    start_f, start_n = -(-packed.F.size // 8) * 8, packed.N.size
    more = max(tracking_floats(packed.rows, packed.cols), folding_floats(packed.rows, packed.cols))
    F = np.concatenate([packed.F, np.full(start_f - packed.F.size + more + 64, np.nan)])
    N = np.concatenate([packed.N, np.full(packed.N.size + 64, 1 << 40)])
    bounds = _bound_and_fold(F, N, X, J, packed.tables, packed.root, 0, 0, start_n, start_f, least, large)
    return F, N, X, J, packed, start_f, start_n, bounds


def _values(F: Floats, N: Integers, units: list[Unit], points: Floats) -> Floats:
    """The output of a system at points: every column's weights from ``col_begin`` to ``col_end`` alone."""
    rows, cols, levels = int(N[memory.SYS_ROWS]), int(N[memory.SYS_COLS]), int(N[memory.SYS_LEVELS])
    row_unit, rest = np.split(N[memory.SYS_HEADER + levels + 1 :], [rows])
    row_col, _, begin, end, _ = np.split(rest, np.cumsum([rows + 1, cols, cols, cols]))
    affine = F[: 4 * rows].reshape(4, rows)
    at = int(memory.weights_of(0, rows))
    weights = F[at : at + cols * rows].reshape(cols, rows)
    out_weights, out_affine = F[at + cols * rows :][:cols], F[at + cols * rows + memory.padded(cols) :][:4]
    coordinates = np.hstack([points, np.ones((len(points), 1))])
    outputs = np.zeros((len(points), cols))
    for r in range(rows):
        if row_unit[r] < 0:
            continue
        t = coordinates @ affine[:, r]
        for c in range(cols):
            if begin[c] <= r < end[c]:
                t = t + weights[c, r] * outputs[:, c]
        unit = units[row_unit[r]]
        columns = slice(row_col[r], row_col[r + 1])
        if unit.table is None:
            raise AssertionError("only units with knots are packed")
        piece = np.searchsorted(unit.table.knots, t)
        outputs[:, columns] = (unit.table.slopes[:, piece] * t + unit.table.intercepts[:, piece]).T
    return np.asarray(coordinates @ out_affine + outputs @ out_weights)


def _with_skips(layers: list[int], seed: int) -> Network:
    """Dense layers in which every third layer reads the outputs of the first one again."""
    random = np.random.default_rng(seed)
    network = dense(layers, seed=seed)
    starts = np.cumsum([3, *layers])
    units = list(network.units)
    for layer in range(3, len(layers), 3):
        for g in range(starts[layer] - 3, starts[layer + 1] - 3):
            row = units[g].row
            columns = np.concatenate([np.arange(3, 3 + layers[0]), row.columns])
            weights = np.concatenate([random.normal(size=layers[0]) * 0.3, row.weights])
            units[g] = replace(units[g], row=AffineRow(columns, weights, row.bias))
    return Network(3, tuple(units), network.output)


def _sparse(layers: list[int], seed: int, reads: int = 3) -> Network:
    """Every unit reads a few outputs of its layer before, and of all earlier ones: columns end within levels."""
    random = np.random.default_rng(seed)
    network = dense(layers, seed=seed)
    starts = np.cumsum([3, *layers])
    units = list(network.units)
    for layer in range(1, len(layers)):
        for g in range(starts[layer] - 3, starts[layer + 1] - 3):
            own = random.integers(starts[layer - 1], starts[layer], 1)
            columns = np.union1d(own, random.integers(0, starts[layer], reads))
            row = AffineRow(columns, random.normal(size=columns.size), units[g].row.bias)
            units[g] = replace(units[g], row=row)
    return Network(3, tuple(units), network.output)


NETWORKS: dict[str, Any] = {
    "one level": lambda: dense([40], seed=1),
    "three levels": lambda: dense([24, 24, 24], seed=2),
    "seven levels": lambda: dense([20, 33, 17, 40, 12, 25, 30], seed=3),
    "skips": lambda: _with_skips([24, 20, 16, 24, 20, 24, 18], seed=4),
    "sparse": lambda: _sparse([22, 19, 26, 21, 30, 17, 23], seed=7),
    "tables": lambda: random_tables(3, (6, 6, 5, 6, 4), n_knots=4, n_outputs=3),
}


def _assert_same_function(network: Network, F: Floats, N: Integers, lower: Floats, upper: Floats) -> None:
    units = [network.units[int(g)] for g in np.argsort(network.unit_level, kind="stable")]
    points = np.random.default_rng(5).uniform(lower, upper, (200, 3))
    expected = naive_values(network, points, tables=True)
    np.testing.assert_allclose(_values(F, N, units, points), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("least", [UNSTABLE, LINEAR], ids=["all settled", "dead only"])
@pytest.mark.parametrize("large", [False, True], ids=["bounded", "large"])
@pytest.mark.parametrize("name", NETWORKS)
def test_folded_systems_are_the_same_function(name: str, least: int, large: bool) -> None:
    network = canonicalize(NETWORKS[name](), lower=LOWER, upper=UPPER).network
    packed = pack(network, LOWER, UPPER)
    _assert_same_function(network, packed.F, packed.N, LOWER, UPPER)
    F, N, (linear, dead, _) = _fold(network, least, large)
    left_out = linear + dead if least == UNSTABLE else dead
    assert left_out > 0 or (name, least) == ("tables", LINEAR)
    assert N[memory.SYS_UNITS] == packed.N[memory.SYS_UNITS] - left_out
    _assert_same_function(network, F, N, LOWER, UPPER)


@pytest.mark.parametrize("least", [UNSTABLE, LINEAR], ids=["all settled", "dead only"])
@pytest.mark.parametrize("name", NETWORKS)
def test_systems_are_folded_again(name: str, least: int) -> None:
    network = canonicalize(NETWORKS[name](), lower=LOWER, upper=UPPER).network
    F, N, X, J, packed, floats, system, _ = _fold_in_place(network, least, False, LOWER, UPPER)
    again_f = -(-(floats + int(N[system + memory.SYS_FLOATS])) // 8) * 8
    again_n = system + int(N[system + memory.SYS_INTS])
    F[again_f:] = np.nan
    F, N = np.concatenate([F, np.full(F.size, np.nan)]), np.concatenate([N, np.full(N.size, 1 << 40)])
    # The half of the cell where all coordinates are low.
    at, vertices = (int(N[packed.root + entry]) for entry in (memory.CELL_FLOATS, memory.CELL_VERTICES))
    corners = F[at : at + 3 * vertices].reshape(3, vertices)
    corners[:] = 0.5 * (corners + LOWER[:, None])
    linear, dead, _ = _bound_and_fold(
        F, N, X, J, packed.tables, packed.root, system, floats, again_n, again_f, UNSTABLE, False
    )
    assert linear + dead > 0
    assert N[again_n + memory.SYS_UNITS] == N[system + memory.SYS_UNITS] - linear - dead
    _assert_same_function(network, F[again_f:], N[again_n:], LOWER, 0.5 * (LOWER + UPPER))


@pytest.mark.parametrize("seed", range(20))
def test_columns_that_end_within_levels_are_substituted(seed: int) -> None:
    lower, upper = np.full(3, -0.3), np.full(3, 0.3)
    network = canonicalize(_sparse([52, 49, 56, 51, 38], seed, reads=1), lower=lower, upper=upper).network
    F, N, (linear, _, _) = _fold(network, UNSTABLE, False, lower, upper)
    assert linear > 0
    _assert_same_function(network, F, N, lower, upper)


def _fold_large(large: bool) -> tuple[Floats, Integers, tuple[int, int, bool]]:
    """Six levels of 60 units on a box so large that hardly any unit of later levels settles."""
    lower, upper = np.full(3, -0.2), np.full(3, 0.2)
    network = canonicalize(dense([60] * 6, seed=6), lower=lower, upper=upper).network
    return _fold(network, UNSTABLE, large, lower, upper)


def test_large_cells_are_not_bounded_behind_levels_that_do_not_settle() -> None:
    _, _, (linear, dead, bounded) = _fold_large(False)
    _, _, (few_linear, few_dead, all_bounded) = _fold_large(True)
    assert bounded
    assert not all_bounded
    assert 0 < few_linear + few_dead < linear + dead


def test_columns_are_read_only_as_far_as_substitution_carries_them() -> None:
    _, N, _ = _fold_large(True)
    rows, cols, levels = int(N[memory.SYS_ROWS]), int(N[memory.SYS_COLS]), int(N[memory.SYS_LEVELS])
    starts = N[memory.SYS_HEADER :][: levels + 1]
    col_begin, col_end = N[memory.SYS_HEADER + levels + 1 + 2 * rows + 1 + cols :][: 2 * cols].reshape(2, cols)
    assert levels == 6
    # The first level through settled units of later ones, the last but one by the last alone.
    assert starts[2] < col_end[0] < rows
    assert np.all(col_end[col_begin == starts[3]] <= starts[5])
    assert np.all(col_end[col_begin == starts[4]] == starts[5])
