"""Bounds that the traversal takes of units: they enclose the units, and tracked errors make them tighter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ir_networks import dense, naive_values, with_flat_units
from numba import njit
from numpy.typing import NDArray

from mn_onnx.extract import schedule
from mn_onnx.extract.kernels.bound import bound_output_form, bound_units
from mn_onnx.extract.kernels.error_symbols import tracking_floats
from mn_onnx.extract.kernels.lanes import pointer
from mn_onnx.extract.kernels.march import load_states, point_at_tables
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    HIGH,
    J_REGIONS,
    LOW,
    RADIUS,
    SYS_HEADER,
    SYS_ROWS,
    X_REGIONS,
    symbol_stride,
)
from mn_onnx.extract.pack import Packed, pack
from mn_onnx.extract.schedule import traverse
from mn_onnx.ir.network import AffineRow, Network
from mn_onnx.ir.passes import canonicalize
from oracle.random_networks import random_tables

Floats = NDArray[np.float64]
LOWER, UPPER = np.array([0.1, -0.3, 0.2]), np.array([0.3, -0.1, 0.4])
# Of numpy's: for constants of Python's, numba would compile the kernels once more.
FIRST, NO = np.int64(0), np.bool_(False)


@njit  # type: ignore[untyped-decorator]
def _bound(F: Any, N: Any, X: Any, J: Any, tables: Any, cell: int, scratch: int, tracked: bool) -> float:
    M = X.size // X_REGIONS
    f, n, x, j = pointer(F), pointer(N), pointer(X), pointer(J)
    load_states(n, j, M, cell, N[SYS_ROWS])
    _, _, _, radius = bound_units(f, n, x, j, M, point_at_tables(tables), cell, FIRST, FIRST, scratch, tracked, NO)
    return radius


@njit  # type: ignore[untyped-decorator]
def _bound_backwards(F: Any, N: Any, X: Any) -> float:
    return bound_output_form(pointer(F), pointer(N), pointer(X), X.size // X_REGIONS, FIRST, FIRST)


def _bounded(packed: Packed, tracked: bool) -> tuple[Floats, Floats, int, float]:
    """F and X after the pass, the size of X's regions, and the output's radius if it has been tracked."""
    room = max(packed.rows, symbol_stride(packed.cols)) + 8
    X, J = np.zeros(X_REGIONS * room), np.zeros(J_REGIONS * room, np.int64)
    F = np.concatenate([packed.F, np.zeros(tracking_floats(packed.rows, packed.cols))])
    radius = _bound(F, packed.N, X, J, packed.tables, packed.root, packed.F.size, tracked)
    return F, X, room, radius


def _radii(packed: Packed, tracked: bool) -> tuple[Floats, Floats, Floats]:
    """Lowest and highest centre and the radius of every unit, in the packed order."""
    _, X, room, _ = _bounded(packed, tracked)
    row_unit = packed.N[SYS_HEADER + packed.levels + 1 :][: packed.rows]
    rows = np.flatnonzero(row_unit >= 0)
    low, high, radius = (X[region * room :][rows] for region in (LOW, HIGH, RADIUS))
    return low, high, radius


def _pre_activations(network: Network, points: Floats) -> Floats:
    """[units, n], in the packed order."""
    order = np.argsort(network.unit_level, kind="stable")
    return np.stack(
        [naive_values(Network(3, network.units[: int(g)], network.units[g].row), points, tables=True) for g in order]
    )


@pytest.mark.parametrize("layers", [[12] * 6, [9, 5, 7, 6, 10, 8, 9]], ids=str)
def test_tracked_errors_enclose_units_more_tightly(layers: list[int]) -> None:
    network = canonicalize(dense(layers, seed=4), lower=LOWER, upper=UPPER).network
    packed = pack(network, LOWER, UPPER)
    low, high, tracked = _radii(packed, True)
    _, _, summed = _radii(packed, False)
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (4000, 3))
    values = _pre_activations(network, points)
    margin = 1e-12
    assert np.all(values >= (low - tracked - margin)[:, None])
    assert np.all(values <= (high + tracked + margin)[:, None])
    assert np.all(tracked <= summed * (1.0 + 1e-12))
    assert np.array_equal(tracked == 0.0, summed == 0.0)
    assert tracked[-3:].max() < 0.5 * summed[-3:].max()


def _radii_by_zonotopes(network: Network) -> Floats:
    """Radii of the units of dense layers of ReLU: from tables of every unit's own error, in float64."""
    corners = np.array([[(LOWER, UPPER)[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)])
    centres, errors, radii = np.zeros((3 + len(network.units), 4)), np.zeros((3 + len(network.units), 0)), []
    centres[:3, :3] = np.eye(3)
    for g, unit in enumerate(network.units):
        weights = unit.row.weights
        centre = weights @ centres[unit.row.columns] + [0.0, 0.0, 0.0, unit.row.bias]
        error = weights @ errors[unit.row.columns]
        radii.append(np.abs(error).sum())
        values = corners @ centre[:3] + centre[3]
        low, high = values.min() - radii[-1], values.max() + radii[-1]
        slope = np.clip(high, 0.0, None) / (high - low) if low < 0.0 else 1.0
        own = max(-0.5 * slope * low, 0.0)
        centres[3 + g] = slope * centre + [0.0, 0.0, 0.0, own]
        errors = np.hstack([errors, np.zeros((len(errors), 1))])
        errors[3 + g] = np.append(slope * error, own)
    return np.array(radii)


def _compared_with_zonotopes(network: Network) -> tuple[Floats, NDArray[np.bool_]]:
    """How high every unit may be by its tracked radius, and whether that is more than a zonotope's, but for rounding.

    Asserts that no radius is smaller than a zonotope's, or larger than without tracking.
    """
    expected = _radii_by_zonotopes(network)
    packed = pack(canonicalize(network, lower=LOWER, upper=UPPER).network, LOWER, UPPER)
    _, high, tracked = _radii(packed, True)
    _, _, summed = _radii(packed, False)
    assert np.all(tracked >= expected * (1.0 - 1e-9))
    assert np.all(tracked <= summed * (1.0 + 1e-12))
    return high + tracked, tracked > expected + 1e-3 * summed


@pytest.mark.parametrize("layers", [[12] * 6, [40, 33, 50, 7, 45, 41]], ids=str)
def test_tracked_errors_are_those_of_zonotopes_but_for_rounding(layers: list[int]) -> None:
    highest, wider = _compared_with_zonotopes(dense(layers, seed=8))
    assert np.all(highest[wider] < 0.0)


def _with_units_below_their_knots(layers: list[int], seed: int) -> Network:
    """Dense layers in which most units, in no regular order, are zero in all of the box."""
    network = dense(layers, seed=seed)
    below = np.random.default_rng(seed).random(len(network.units)) < 0.6
    rows = [replace(unit.row, bias=unit.row.bias - 3.0 * low) for unit, low in zip(network.units, below, strict=True)]
    units = tuple(replace(unit, row=row) for unit, row in zip(network.units, rows, strict=True))
    return Network(3, units, network.output)


@pytest.mark.parametrize("layers", [[48] * 6, [60, 52, 36, 64, 44, 57]], ids=str)
def test_units_proved_zero_before_need_no_row_of_errors(layers: list[int]) -> None:
    highest, without_row = _compared_with_zonotopes(_with_units_below_their_knots(layers, seed=3))
    starts = np.cumsum([0, *layers])
    assert np.add.reduceat(without_row, starts[2:-1], dtype=np.int64).min() > 8
    assert np.all(highest[without_row] < 0.0)


def test_errors_go_on_through_flat_outputs_as_their_own() -> None:
    plain = canonicalize(dense([24] * 6, seed=2), lower=LOWER, upper=UPPER).network
    network = canonicalize(with_flat_units([24] * 6, seed=2), lower=LOWER, upper=UPPER).network
    _, _, without_flat = _radii(pack(plain, LOWER, UPPER), True)
    low, high, tracked = _radii(pack(network, LOWER, UPPER), True)
    _, _, summed = _radii(pack(network, LOWER, UPPER), False)
    values = _pre_activations(network, np.random.default_rng(0).uniform(LOWER, UPPER, (2000, 3)))
    assert np.all(values >= (low - tracked - 1e-12)[:, None])
    assert np.all(values <= (high + tracked + 1e-12)[:, None])
    assert np.all(tracked <= summed * (1.0 + 1e-12))
    assert without_flat[-24:].mean() < tracked[-24:].mean() < summed[-24:].mean()


@pytest.mark.parametrize(
    "network",
    [
        dense([12] * 6, seed=8),
        dense([40, 33, 50, 7, 45, 41], seed=8),
        random_tables(3, (3, 3, 3, 3, 2), n_knots=4, n_outputs=3),
    ],
    ids=["narrow", "wide", "several outputs"],
)
def test_a_tracked_output_is_what_a_backward_pass_gives(network: Network) -> None:
    packed = pack(canonicalize(network, lower=LOWER, upper=UPPER).network, LOWER, UPPER)
    F, X, room, radius = _bounded(packed, True)
    centre = X[CENTRE_AT * room :][:4].copy()
    expected = _bound_backwards(F, packed.N, X)
    assert expected > 0.0
    assert X[CENTRE_AT * room :][:4] == pytest.approx(centre, rel=1e-12)
    assert expected * (1.0 - 1e-9) <= radius <= expected * 1.01
    assert _bounded(packed, False)[-1] == -1.0


@pytest.mark.parametrize("power", [-100, -50, 50, 140])
def test_errors_too_large_or_small_for_float32_are_not_tracked(power: int) -> None:
    plain = canonicalize(dense([16] * 6, seed=5), lower=LOWER, upper=UPPER).network
    scaled = _rescaled(plain, 16, 2.0**power)
    _, _, tracked = _radii(pack(plain, LOWER, UPPER), True)
    low, high, radius = _radii(pack(scaled, LOWER, UPPER), True)
    _, _, summed = _radii(pack(scaled, LOWER, UPPER), False)
    assert np.array_equal(radius, summed)
    assert np.all(radius[32:] >= tracked[32:])
    values = _pre_activations(scaled, np.random.default_rng(2).uniform(LOWER, UPPER, (500, 3)))
    margin = 1e-12 * (np.abs(low) + np.abs(high))
    assert np.all(values >= (low - radius - margin)[:, None])
    assert np.all(values <= (high + radius + margin)[:, None])


def _rescaled(network: Network, width: int, factor: float) -> Network:
    """The same function of ReLU units, those of the first ``width`` times ``factor``."""
    scale = np.ones(3 + len(network.units))
    scale[3 : 3 + width] = factor
    units = []
    for g, unit in enumerate(network.units):
        row, own = unit.row, scale[3 + g]
        weights = row.weights * own / scale[row.columns]
        units.append(replace(unit, row=AffineRow(row.columns, weights, row.bias * own)))
    out = network.output
    return Network(3, tuple(units), AffineRow(out.columns, out.weights / scale[out.columns], out.bias))


def test_tracked_errors_enclose_units_of_several_outputs() -> None:
    network = random_tables(3, (3, 3, 3, 3, 2), n_knots=4, n_outputs=3)
    packed = pack(network, LOWER, UPPER)
    low, high, radius = _radii(packed, True)
    _, _, summed = _radii(packed, False)
    values = _pre_activations(network, np.random.default_rng(1).uniform(LOWER, UPPER, (4000, 3)))
    # Rows of several knots keep their bounds with the radius in LOW and HIGH already.
    assert np.all(values >= (low - radius - 1e-12)[:, None])
    assert np.all(values <= (high + radius + 1e-12)[:, None])
    assert np.all(radius <= summed)


def test_polygons_do_not_depend_on_how_often_cells_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    lower, upper = np.full(3, -1.0), np.full(3, 1.0)
    network = canonicalize(dense([14] * 6, seed=11), lower=lower, upper=upper).network
    results = []
    for share in (1, 1000):
        monkeypatch.setattr(schedule, "LARGE_SHARE", share)
        results.append(traverse(network, lower, upper, threads=1))
    (often, often_counts), (seldom, seldom_counts) = results
    assert seldom_counts.nodes > often_counts.nodes
    assert often.offsets.size > 100
    # The polygons come in the order of the cells.
    assert np.array_equal(np.sort(np.diff(often.offsets)), np.sort(np.diff(seldom.offsets)))
    assert np.array_equal(np.unique(often.keys, axis=0), np.unique(seldom.keys, axis=0))


def test_most_cells_of_a_curved_surface_are_trimmed() -> None:
    lower, upper = np.full(3, -1.0), np.full(3, 1.0)
    network = canonicalize(dense([24, 24], seed=2), lower=lower, upper=upper).network
    _, statistics = traverse(network, lower, upper, threads=1)
    assert statistics.nodes > 100
    assert statistics.trimmed > 0.2 * statistics.nodes
    assert statistics.broken_cuts == 0
