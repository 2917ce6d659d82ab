"""Shaving leaves every polygon as it is, whatever cells are shaved."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from ir_networks import RELU, dense, naive_values

from mn_onnx.extract import schedule
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.schedule import TraversalStatistics, traverse
from mn_onnx.extract.weld import weld
from mn_onnx.ir.network import AffineRow, Network, Unit
from mn_onnx.ir.passes import canonicalize
from oracle.compare import disagreements
from oracle.level_set import exact_level_set
from oracle.random_networks import RandomNetwork, random_tables
from oracle.sketch import as_network
from oracle.strategies import random_networks

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
BOUNDS = np.stack([LOWER, UPPER], axis=1)
ALL, NONE = 1, 10**9
SETTINGS = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], max_examples=30)
NETWORKS = {
    "two layers": RandomNetwork(3, (("relu", 5), ("relu", 5)), True, 2),
    "three layers": RandomNetwork(3, (("relu", 6), ("relu", 5), ("relu", 4)), False, 3),
    "clip, abs, leaky": RandomNetwork(3, (("clip", 3), ("abs", 3), ("leaky_relu", 3)), True, 11),
    "six layers": RandomNetwork(3, (("relu", 3),) * 6, True, 12),
}


def _shave(patch: pytest.MonkeyPatch, levels: int, units: int) -> None:
    patch.setattr(schedule, "TRACKED_LEVELS", levels)
    patch.setattr(schedule, "TRACKED_UNITS", units)


def _assert_exact(network: Network) -> TraversalStatistics:
    soup, statistics = traverse(network, LOWER, UPPER, threads=1)
    assert disagreements(soup, exact_level_set(network, LOWER, UPPER)) == []
    assert check_invariants(weld(soup), bounds=BOUNDS).problems() == []
    assert statistics.broken_cuts == 0
    return statistics


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_match_the_oracle_when_all_cells_are_shaved(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "LEAF_CHOICES", 1)  # so that there are more cells
    _shave(monkeypatch, ALL, ALL)
    assert _assert_exact(as_network(NETWORKS[name].centred())).shaved > 5


def test_units_of_several_knots_and_outputs_are_shaved_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "LEAF_CHOICES", 1)
    _shave(monkeypatch, ALL, ALL)
    assert _assert_exact(random_tables(3, (2, 2, 2), n_knots=3, n_outputs=3)).shaved > 2


@SETTINGS
@given(random_networks())
def test_any_network_matches_the_oracle_when_all_cells_are_shaved(body: RandomNetwork) -> None:
    with pytest.MonkeyPatch.context() as patch:
        _shave(patch, ALL, ALL)
        _assert_exact(as_network(body))


def test_shaving_saves_cells_and_changes_no_polygon(monkeypatch: pytest.MonkeyPatch) -> None:
    network = canonicalize(dense([14] * 6, seed=11), lower=LOWER, upper=UPPER).network
    results = []
    for levels, units in ((ALL, ALL), (schedule.TRACKED_LEVELS, schedule.TRACKED_UNITS), (ALL, NONE)):
        _shave(monkeypatch, levels, units)
        results.append(traverse(network, LOWER, UPPER, threads=1))
    (most, most_counts), (some, some_counts), (none, none_counts) = results
    assert most_counts.shaved > some_counts.shaved > none_counts.shaved == 0
    assert most_counts.nodes < some_counts.nodes < none_counts.nodes
    for soup in (most, some):
        # The polygons come in the order of the cells.
        assert np.array_equal(np.sort(np.diff(soup.offsets)), np.sort(np.diff(none.offsets)))
        assert np.array_equal(np.unique(soup.keys, axis=0), np.unique(none.keys, axis=0))
        assert check_invariants(weld(soup), bounds=BOUNDS).problems() == []


def test_polygons_of_shaved_cells_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    _shave(monkeypatch, ALL, ALL)
    network = canonicalize(dense([14] * 6, seed=11), lower=LOWER, upper=UPPER).network
    (one, _), (three, counts) = (traverse(network, LOWER, UPPER, threads=threads) for threads in (1, 3))
    assert counts.shaved > 0
    assert np.array_equal(one.offsets, three.offsets)
    assert np.array_equal(one.corner_keys, three.corner_keys)


def test_shallow_networks_are_not_shaved() -> None:
    network = canonicalize(dense([40, 24], seed=2), lower=LOWER, upper=UPPER).network
    assert traverse(network, LOWER, UPPER, threads=1)[1].shaved == 0


def _three_sheets() -> Network:
    """Zero on three planes; between two of them two terms that cancel, one of a unit that is zero near all planes.

    f along the first coordinate: from -0.8 at -1 to 0.5, back to -0.5, and to 0.8 at 1.
    """
    tilted = np.array([1.0, 0.0625, 0.03125])
    bump = np.array([-0.375, -0.25, -0.125])
    slope = 4.25
    profile = np.array([[-1.0, -0.8], [-0.55, 0.5], [0.0, 0.5], [0.4, -0.5], [0.5, -0.5], [1.0, 0.8]])
    slopes = np.diff(profile[:, 1]) / np.diff(profile[:, 0])
    turns = dict(zip(profile[1:-1, 0], np.diff(slopes), strict=True))
    turns |= dict(zip(bump, [-slope, 2.0 * slope, -slope], strict=True))
    knots = np.array(sorted(turns))
    coordinates = np.arange(3)
    units = [Unit(AffineRow(coordinates, tilted, -float(knot)), (RELU,), f"at {knot}") for knot in knots]
    units.append(Unit(AffineRow(coordinates, -tilted, float(bump[1])), (RELU,), "back"))
    sides = 3 + np.array([int(np.searchsorted(knots, bump[1])), len(knots)])
    units.append(Unit(AffineRow(sides, np.full(2, -slope), slope * 0.125), (RELU,), "bump"))
    columns = np.concatenate([coordinates, 3 + np.arange(len(knots)), [3 + len(knots) + 1]])
    weights = np.concatenate([slopes[0] * tilted, [turns[knot] for knot in knots], [1.0]])
    return Network(3, tuple(units), AffineRow(columns, weights, float(profile[0, 1] + slopes[0])))


def test_slices_without_surface_between_others_keep_their_states(monkeypatch: pytest.MonkeyPatch) -> None:
    _shave(monkeypatch, ALL, ALL)
    monkeypatch.setattr(schedule, "LARGE_SHARE", 0.1)  # so that the whole box is bounded, too
    network = canonicalize(_three_sheets(), lower=LOWER, upper=UPPER).network
    points = np.linspace(LOWER, UPPER, 2001)
    assert np.count_nonzero(np.diff(np.sign(naive_values(network, points, tables=True)))) == 3
    assert _assert_exact(network).shaved > 0
