"""Dividing polygons: still closed, nothing moved, and what polygons carry goes to their parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from smooth_models import soft_octahedron_model

from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.smooth.subdivide import subdivide
from mn_onnx.extract.surface import Surface
from mn_onnx.extraction import extract

CUT_BOX = np.array([[-0.21, 1.0], [-1.0, 1.0], [-1.0, 0.17]])


@pytest.fixture(scope="module")
def closed() -> Surface:
    return extract(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6, threads=1)


@pytest.fixture(scope="module")
def cut() -> Surface:
    return extract(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6, threads=1, bounds=CUT_BOX)


def all_free(surface: Surface) -> np.ndarray:
    return np.ones((surface.n_vertices, 3), bool)


@pytest.mark.parametrize("share", [1.0, 0.3, 0.0])
def test_a_closed_surface_stays_closed_and_where_it_is(closed: Surface, share: float) -> None:
    chosen = np.flatnonzero(np.random.default_rng(0).random(closed.n_polygons) < share)
    labelled = replace(closed, attributes={"label": np.arange(closed.n_polygons)})
    division = subdivide(labelled, chosen, all_free(closed), closed.vertices, 1)
    divided, order = division.surface, division.order
    before, after = check_invariants(closed), check_invariants(divided)
    assert after.problems() == []
    assert (after.euler, len(after.components)) == (before.euler, len(before.components))
    assert after.area == pytest.approx(before.area, rel=1e-12)
    assert after.volume == pytest.approx(before.volume, rel=1e-12)
    known = order < closed.n_vertices
    np.testing.assert_array_equal(divided.vertices[known], closed.vertices[order[known]])
    assert len(division.free) == divided.n_vertices - closed.n_vertices
    new = order[~known]
    np.testing.assert_array_equal(division.carried, divided.vertices[~known])
    assert np.count_nonzero(division.centre_of >= 0) == chosen.size
    np.testing.assert_array_equal(np.sort(new), np.arange(closed.n_vertices, divided.n_vertices))
    whole = np.flatnonzero(division.whole)
    assert np.count_nonzero(~division.whole) >= chosen.size
    for polygon in whole[:: max(1, whole.size // 50)].tolist():
        parent = division.parents[polygon]
        found = divided.corners[divided.offsets[polygon] : divided.offsets[polygon + 1]]
        was = closed.corners[closed.offsets[parent] : closed.offsets[parent + 1]]
        np.testing.assert_array_equal(order[found], was)
    parts = np.bincount(divided.attributes["label"], minlength=closed.n_polygons)
    assert (parts[chosen] >= 2).all()
    assert (np.delete(parts, chosen) == 1).all()
    areas = np.bincount(divided.attributes["label"], divided.measures.areas)
    np.testing.assert_allclose(areas, closed.measures.areas, rtol=1e-9, atol=1e-15)


def test_vertices_are_numbered_by_their_first_corner(closed: Surface) -> None:
    divided = subdivide(closed, np.arange(0, closed.n_polygons, 3), all_free(closed), closed.vertices, 1).surface
    _, first = np.unique(divided.corners, return_index=True)
    assert (np.diff(first) > 0).all()


def test_new_vertices_on_the_box_stay_on_its_faces(cut: Surface) -> None:
    assert cut.boundary.size > 0
    division = subdivide(cut, np.arange(cut.n_polygons), all_free(cut), cut.vertices, 1)
    assert check_invariants(division.surface, bounds=CUT_BOX).problems() == []
    new = division.surface.vertices[division.order >= cut.n_vertices]
    on_box = (new[:, :, None] == CUT_BOX).any(axis=2)
    assert on_box.any()
    np.testing.assert_array_equal(division.free, ~on_box)
