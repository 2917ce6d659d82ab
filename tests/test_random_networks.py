"""Extraction of random networks in general position against the exact oracle, polygon by polygon."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from mn_onnx.extract import schedule
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.weld import weld
from mn_onnx.ir.network import Network
from oracle.compare import disagreements
from oracle.level_set import exact_level_set
from oracle.random_networks import RandomNetwork, random_tables, table_values
from oracle.sketch import as_network
from oracle.strategies import random_networks, random_table_networks

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
BOUNDS = np.stack([LOWER, UPPER], axis=1)

NETWORKS = [
    RandomNetwork(3, (("relu", 6),), False, 1),
    RandomNetwork(3, (("relu", 5), ("relu", 5)), True, 2),
    RandomNetwork(3, (("relu", 6), ("relu", 5), ("relu", 4)), False, 3),
    RandomNetwork(3, (("relu", 4), ("relu", 4), ("relu", 4)), True, 5),
    RandomNetwork(3, (("leaky_relu", 4), ("leaky_relu", 4), ("leaky_relu", 3)), False, 6),
    RandomNetwork(3, (("clip", 4), ("clip", 4)), True, 7),
    RandomNetwork(3, (("abs", 3), ("abs", 3), ("abs", 2)), False, 8),
    RandomNetwork(3, (("maximum", 4), ("maximum", 4), ("maximum", 3)), False, 9),
    RandomNetwork(3, (("minimum", 4), ("maximum", 4)), True, 10),
    RandomNetwork(3, (("clip", 3), ("abs", 3), ("leaky_relu", 3)), True, 11),
    RandomNetwork(3, (("relu", 3),) * 6, True, 12),
    RandomNetwork(3, (("leaky_relu", 3),) * 5, True, 13),
]
SETTINGS = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


def _assert_exact(network: Network) -> PolygonSoup:
    """The soup agrees with the oracle, closes when welded, and ``f`` vanishes on its polygons."""
    soup, _ = traverse(network, LOWER, UPPER)
    assert disagreements(soup, exact_level_set(network, LOWER, UPPER)) == []
    assert check_invariants(weld(soup), bounds=BOUNDS).problems() == []
    if len(soup.positions):
        assert np.abs(table_values(network, np.concatenate([soup.positions, _face_samples(soup)]))).max() < 1e-12
    return soup


def _face_samples(soup: PolygonSoup) -> np.ndarray:
    """One random convex combination of the corners per polygon."""
    weights = np.random.default_rng(0).exponential(size=(len(soup.corners), 1))
    starts = soup.offsets[:-1]
    return np.add.reduceat(weights * soup.corner_positions, starts) / np.add.reduceat(weights, starts)


@pytest.mark.parametrize("choices", [1, 32])
def test_leaves_of_any_size_match_oracle(choices: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one choice every cell is split to the end; with many the states of whole cells are enumerated."""
    monkeypatch.setattr(schedule, "LEAF_CHOICES", choices)
    for body in NETWORKS[5:8]:
        _assert_exact(as_network(body.centred()))
    _assert_exact(random_tables(5, (3, 3), n_knots=4))


@pytest.mark.parametrize("body", NETWORKS, ids=str)
def test_network_matches_oracle(body: RandomNetwork) -> None:
    soup = _assert_exact(as_network(body.centred()))
    assert len(soup.offsets) > 10


@pytest.mark.parametrize(
    ("seed", "layers", "n_outputs"), [(1, (4,), 1), (2, (3, 3), 2), (3, (2, 2, 2), 3), (4, (3, 2), 1), (5, (2,) * 5, 2)]
)
def test_tables_with_several_knots_and_outputs_match_oracle(seed: int, layers: tuple[int, ...], n_outputs: int) -> None:
    soup = _assert_exact(random_tables(seed, layers, n_knots=4, n_outputs=n_outputs))
    assert len(soup.offsets) > 5


def test_box_of_unequal_sides_away_from_the_origin_matches_oracle() -> None:
    network = as_network(NETWORKS[1].centred())
    lower, upper = np.array([-0.25, -3.0, 0.125]), np.array([0.5, 1.0, 2.0])
    soup, _ = traverse(network, lower, upper)
    assert len(soup.offsets) > 5
    assert disagreements(soup, exact_level_set(network, lower, upper)) == []


@given(random_networks())
@settings(SETTINGS, max_examples=25)
def test_any_network_matches_oracle(body: RandomNetwork) -> None:
    _assert_exact(as_network(body))


@given(random_table_networks())
@settings(SETTINGS, max_examples=20)
def test_any_tables_match_oracle(network: Network) -> None:
    _assert_exact(network)


@pytest.mark.slow
@given(random_networks(max_width=6))
@settings(SETTINGS, max_examples=300)
def test_many_networks_match_oracle(body: RandomNetwork) -> None:
    _assert_exact(as_network(body))


@pytest.mark.slow
@given(random_table_networks())
@settings(SETTINGS, max_examples=300)
def test_many_tables_match_oracle(network: Network) -> None:
    _assert_exact(network)
