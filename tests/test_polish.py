"""Polishing: onto the true level set, with the same topology and no face turned over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_models import octahedron_model
from smooth_models import soft_octahedron_model

from mn_onnx.extract.polish import polish
from mn_onnx.extract.surface import Surface
from mn_onnx.extraction import extract
from mn_onnx.model import Model, load


def area_vectors(surface: Surface) -> np.ndarray:
    return np.asarray(surface.measures.area_vectors)


@pytest.fixture(scope="module")
def model() -> Model:
    return load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6)


def test_vertices_reach_the_level_set(model: Model) -> None:
    before = extract(model, threads=1)
    after = extract(model, threads=1, polish=True)
    assert before.report["true_mean_abs_f"] > 1e-4
    entries = after.report["polish"]
    assert entries["mean_abs_f_before"] > 1e-4
    assert entries["mean_abs_f"] < 1e-10
    assert np.abs(model.evaluate(after.vertices)).mean() < 1e-10
    assert entries["held_vertices"] == 0
    assert entries["largest_move"] <= 2 * before.attributes["displacement"].max()
    np.testing.assert_array_equal(before.corners, after.corners)
    np.testing.assert_array_equal(before.twins, after.twins)
    assert (np.einsum("ij,ij->i", area_vectors(before), area_vectors(after)) > 0).all()


def test_vertices_on_the_box_stay_on_its_faces() -> None:
    cut = load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6, bounds=[-0.21, 1, -1, 1, -1, 0.17])
    before, after = extract(cut, threads=1), extract(cut, threads=1, polish=True)
    assert before.boundary.size > 0
    for axis, side in ((0, -0.21), (2, 0.17)):
        on_face = before.vertices[:, axis] == side
        assert on_face.any()
        np.testing.assert_array_equal(after.vertices[on_face, axis], side)
    assert after.report["closed"]
    assert after.report["polish"]["mean_abs_f"] < 1e-10


def test_no_face_turns_over(model: Model) -> None:
    """With errors that are taken to be large, vertices of a mesh folded on purpose may not pass each other."""
    surface = extract(model, threads=1)
    rng = np.random.default_rng(0)
    shaken = replace(
        surface,
        vertices=surface.vertices + rng.normal(size=surface.vertices.shape) * 0.004,
        errors=np.full(surface.n_polygons, 0.05),
    )
    moved, result = polish(shaken, model.network, model.lower, model.upper, threads=1)
    assert (np.einsum("ij,ij->i", area_vectors(shaken), area_vectors(moved)) >= 0).all()
    assert result.mean_abs_f < 0.1 * result.mean_abs_f_before


def test_exact_networks_have_nothing_to_polish() -> None:
    assert extract(octahedron_model(), threads=1, polish=True).report["polish"] is None
