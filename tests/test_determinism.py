"""The same mesh, byte for byte, for any number of threads; and the same polygons however the task is put."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

import mn_onnx
from mn_onnx.extract import schedule
from mn_onnx.extract.invariants import Invariants, check_invariants
from mn_onnx.extract.kernels import control as entries
from mn_onnx.extract.pack import pack
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.weld import weld
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from oracle.random_networks import RandomNetwork, random_tables
from oracle.sketch import as_network, evaluate

MODELS = Path(__file__).parents[1] / "models"
LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
BODY = RandomNetwork(3, (("relu", 20), ("leaky_relu", 16), ("relu", 12)), True, 4).centred()
NETWORKS = {
    "relu": as_network(BODY),
    "max": as_network(RandomNetwork(3, (("maximum", 16), ("minimum", 12)), False, 5).centred()),
    "tables": random_tables(6, (8, 8), n_knots=6, n_outputs=3),
}


def _soup(network: Network, threads: int | None = None) -> PolygonSoup:
    soup, _ = traverse(network, LOWER, UPPER, threads=threads)
    assert len(soup.offsets) > 500
    return soup


def _invariants(soup: PolygonSoup) -> Invariants:
    return check_invariants(weld(soup), bounds=np.stack([LOWER, UPPER], axis=1))


def _centroids(soup: PolygonSoup) -> NDArray[np.float64]:
    return np.add.reduceat(soup.corner_positions, soup.offsets[:-1]) / np.diff(soup.offsets)[:, None]


@pytest.mark.parametrize("name", ["am_chair", "niq_fox"])
def test_what_memory_held_before_changes_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also not how many cells are visited: a bound that reads such numbers may still be right, but wider."""
    model = mn_onnx.load(MODELS / f"{name}.onnx")
    counts = []
    for content in (0.0, np.nan):
        monkeypatch.setattr(schedule, "_aligned_floats", lambda size, content=content: np.full(size, content))
        soup, statistics = traverse(model.network, model.lower, model.upper, threads=1)
        counts.append((len(soup.offsets), statistics.nodes, statistics.pruned, statistics.trimmed, statistics.folds))
    assert counts[0] == counts[1]


def _assert_same_polygons(first: PolygonSoup, second: PolygonSoup) -> None:
    """Both have the same polygons in any order: corner counts, centroids and gradients agree one to one."""
    assert len(first.offsets) == len(second.offsets)
    distances, partners = KDTree(_centroids(second)).query(_centroids(first))
    assert distances.max() < 1e-9
    assert len(np.unique(partners)) == len(partners)
    np.testing.assert_array_equal(np.diff(first.offsets), np.diff(second.offsets)[partners])
    np.testing.assert_allclose(first.gradients, second.gradients[partners], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", NETWORKS)
def test_polygons_do_not_depend_on_threads(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers give subtrees away after every few cells, whether another one is idle or not."""
    one = _soup(NETWORKS[name], 1)
    monkeypatch.setattr(schedule, "BUDGET_WHILE_ASKED", 250)
    monkeypatch.setattr(schedule._Pool, "wants_more", lambda pool: True)
    for threads in (2, 4):
        other, statistics = traverse(NETWORKS[name], LOWER, UPPER, threads=threads)
        assert statistics.subtrees > 1
        for array in ("offsets", "corner_keys", "box_faces", "gradients", "errors"):
            assert getattr(one, array).tobytes() == getattr(other, array).tobytes(), array
        # Which corners share a point depends on the worker, and a point lies where its first corner does.
        np.testing.assert_allclose(other.corner_positions, one.corner_positions, rtol=0, atol=1e-12)
        mesh, other_mesh = weld(one), weld(other)
        for array in ("vertices", "corners", "twins"):
            assert getattr(mesh, array).tobytes() == getattr(other_mesh, array).tobytes(), array


@pytest.mark.parametrize("name", NETWORKS)
def test_polygons_do_not_depend_on_the_size_of_leaves(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Splitting every cell to the end and enumerating the states of larger cells are two ways to the same polygons."""
    expected = _soup(NETWORKS[name])
    for choices in (1, 64):
        monkeypatch.setattr(schedule, "LEAF_CHOICES", choices)
        _assert_same_polygons(_soup(NETWORKS[name]), expected)


@pytest.mark.parametrize("name", NETWORKS)
def test_larger_networks_close_with_valence_four(name: str) -> None:
    """In general position: no unmatched edge, four edges at every inner vertex, rims only on the box."""
    invariants = _invariants(_soup(NETWORKS[name]))
    assert invariants.problems() == []
    assert set(invariants.valences) == {4}


def test_values_vanish_at_corners_and_on_faces() -> None:
    soup = _soup(NETWORKS["relu"])
    weights = np.random.default_rng(1).exponential(size=(4, len(soup.corners), 1))
    starts = soup.offsets[:-1]
    sums = np.add.reduceat(weights * soup.corner_positions, starts, axis=1)
    samples = sums / np.add.reduceat(weights, starts, axis=1)
    points = np.concatenate([soup.positions, samples.reshape(-1, 3)])
    assert np.abs(evaluate(BODY, points)).max() < 1e-12


def test_order_of_units_does_not_matter() -> None:
    """Reversing the units of the first layer changes the order of the splits, not the polygons."""
    network = NETWORKS["relu"]
    width = int((network.unit_level == 0).sum())
    old_of_new = np.concatenate([np.arange(width)[::-1], np.arange(width, len(network.units))])
    variable_of_old = np.empty(network.n_variables, np.int64)
    variable_of_old[:3] = np.arange(3)
    variable_of_old[3 + old_of_new] = 3 + np.arange(len(old_of_new))

    def renumbered(row: AffineRow) -> AffineRow:
        columns = variable_of_old[row.columns]
        order = np.argsort(columns)
        return AffineRow(columns[order], row.weights[order], row.bias)

    units = tuple(replace(unit, row=renumbered(unit.row)) for unit in (network.units[old] for old in old_of_new))
    _assert_same_polygons(_soup(network), _soup(Network(3, units, renumbered(network.output))))


def test_order_of_axes_does_not_matter() -> None:
    """Swapping two coordinates mirrors the polygons."""
    network = NETWORKS["relu"]

    def swapped(row: AffineRow) -> AffineRow:
        columns = np.where(row.columns < 2, 1 - row.columns, row.columns)
        order = np.argsort(columns)
        return AffineRow(columns[order], row.weights[order], row.bias)

    units = tuple(replace(unit, row=swapped(unit.row)) for unit in network.units)
    mirrored = _soup(Network(3, units, swapped(network.output)))
    expected = _soup(network)
    axes = [1, 0, 2]
    _assert_same_polygons(
        replace(mirrored, positions=mirrored.positions[:, axes], gradients=mirrored.gradients[:, axes]), expected
    )


def test_boxes_of_an_eighth_give_the_whole() -> None:
    """The surfaces in the eight octants have the area of the surface in the box, and together no inner rim."""
    network = NETWORKS["tables"]
    whole = weld(_soup(network))
    area = 0.0
    for octant in np.ndindex(2, 2, 2):
        lower = np.array(octant, float) - 1.0
        soup, _ = traverse(network, lower, lower + 1.0)
        surface = weld(soup)
        assert check_invariants(surface, bounds=np.stack([lower, lower + 1.0], axis=1)).problems() == []
        area += surface.area
    assert area == pytest.approx(whole.area, rel=1e-12)


def test_further_units_split_polygons_and_keep_the_surface() -> None:
    """A unit that no one reads cuts polygons by its knot plane; area and Euler number stay."""
    network = NETWORKS["relu"]
    table = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.0]])
    reader = AffineRow(np.array([0, 1, 2]), np.array([0.625, -0.5, 0.75]), 0.0625)
    idle = Unit(reader, (table,), "idle", table)
    refined = Network(3, (*network.units, idle), network.output)
    coarse, fine = weld(_soup(network)), weld(_soup(refined))
    assert fine.n_polygons > coarse.n_polygons
    assert fine.area == pytest.approx(coarse.area, rel=1e-12)
    assert check_invariants(fine).euler == check_invariants(coarse).euler


def test_a_worker_asked_for_work_returns_at_once_and_loses_nothing() -> None:
    packed = pack(NETWORKS["relu"], LOWER, UPPER)
    worker, task = schedule._Worker(packed), schedule._Task(packed.F, packed.N, packed.root)
    worker.start(task)
    assert not worker.run(task, 100_000)
    visited = worker.control[entries.NODES]
    worker.control[entries.ASKED] = 1
    assert not worker.run(task, 1 << 60)
    assert worker.control[entries.NODES] == visited
    assert worker.run(task, 1 << 60)
    assert worker.polygons == len(_soup(NETWORKS["relu"]).offsets) - 1
