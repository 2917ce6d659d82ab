"""Polishing: onto the true level set, with the same topology and no face turned over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ir_networks import SINE, dense
from small_models import octahedron_model
from smooth_models import HIGH, LOW, extracted, soft_octahedron_model

from mn_onnx.certificate import certified, polish_notes, polished, topology_notes
from mn_onnx.checks.residual import true_residuals
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.smooth.polish import FLATNESS, polish
from mn_onnx.extract.surface import Surface
from mn_onnx.extraction import extract
from mn_onnx.ir.evaluate import evaluate, gradient
from mn_onnx.ir.expression import T, apply, constant
from mn_onnx.ir.network import AffineRow, Network
from mn_onnx.model import Model, load

ONLY_VERTICES = np.inf


@pytest.fixture(scope="module")
def model() -> Model:
    return load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6)


@pytest.fixture(scope="module")
def before(model: Model) -> Surface:
    return extract(model, threads=1)


def mean_on_faces(network: Network, surface: Surface) -> float:
    points, _ = sample_surface(surface, 1 << 14)
    return float(np.abs(evaluate(network, points, true_functions=True)).mean())


def facing(network: Network, surface: Surface) -> np.ndarray:
    """Areas times slopes along the normals, [p]: by the true gradients at the corners."""
    at_corners = gradient(network, surface.vertices, true_functions=True)[surface.corners]
    means = np.add.reduceat(at_corners, surface.offsets[:-1], axis=0) / surface.polygon_sizes[:, None]
    return np.asarray(np.einsum("ij,ij->i", surface.measures.area_vectors, means))


def test_vertices_reach_the_level_set(model: Model, before: Surface) -> None:
    after, result = polish(before, model.network, LOW, HIGH, threads=1, flatness=ONLY_VERTICES)
    assert result.mean_abs_f_before > 1e-4
    assert result.mean_abs_f < 1e-10
    assert np.abs(model.evaluate(after.vertices)).mean() < 1e-10
    assert result.vertices_within_1e_9 == before.n_vertices
    assert (result.held_vertices, result.stray_vertices, result.turned_polygons, result.divided_polygons) == (0,) * 4
    assert 0 < result.largest_move <= 2 * before.attributes["displacement"].max()
    np.testing.assert_array_equal(before.corners, after.corners)
    np.testing.assert_array_equal(before.twins, after.twins)
    assert (np.einsum("ij,ij->i", before.measures.area_vectors, after.measures.area_vectors) > 0).all()


def test_faces_come_closer_too_and_as_close_as_asked(model: Model, before: Surface) -> None:
    wanted = 0.1 * mean_on_faces(model.network, before)
    slope = float(np.median(np.sqrt((before.gradients**2).sum(axis=1))))
    divided, result = polish(before, model.network, LOW, HIGH, threads=1, flatness=wanted / slope)
    assert before.n_polygons < result.divided_polygons < divided.n_polygons < 30 * before.n_polygons
    assert mean_on_faces(model.network, divided) < 1.3 * wanted
    invariants = check_invariants(divided)
    assert invariants.problems() == []
    assert (invariants.euler, len(invariants.components)) == (2, 1)
    assert np.abs(evaluate(model.network, divided.vertices, true_functions=True)).max() < 1e-8
    np.testing.assert_array_equal(np.unique(divided.errors), np.unique(before.errors))


def test_faces_that_are_fine_enough_stay_whole() -> None:
    fine = load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=16)
    surface = extract(fine, threads=1)
    polished, result = polish(surface, fine.network, LOW, HIGH, threads=1, flatness=0.01)
    assert result.divided_polygons == 0
    assert polished.n_polygons == surface.n_polygons


def test_the_report_tells_of_the_polished_mesh(model: Model) -> None:
    report = extract(model, threads=1, polish=True).report
    entries = report["polish"]
    assert entries["true_mean_abs_f_before"] > 1e-4
    assert entries["surface_eps_median"] < 0.1 * report["surface_eps_median"]
    assert entries["true_mean_abs_f"] < 0.01 * entries["true_mean_abs_f_before"]
    assert report["polygons"] > 100 * report["forecast_polygons"]
    assert (report["closed"], report["euler"], report["problems"]) == (True, 2, [])
    assert report["turned_share"] == 0
    assert 0 < report["gradient_angle_median"] < 45


def test_errors_are_proved_of_the_polished_mesh(model: Model) -> None:
    surface = extract(model, threads=1, polish=True)
    points, polygons = sample_surface(surface, 1 << 14)
    true = np.abs(evaluate(model.network, points, true_functions=True))
    assert (true <= surface.errors[polygons]).all()
    np.testing.assert_array_equal(surface.errors, surface.attributes["eps"])
    assert surface.errors.max() == surface.report["polish"]["surface_eps"]


def test_a_goal_out_of_reach_is_told(model: Model) -> None:
    before = extract(model, threads=1)
    coarse, entries = polished(before, model.canonical, threads=1, most_polygons=before.n_polygons + 1000)
    assert before.n_polygons < coarse.n_polygons <= before.n_polygons + 1000
    entries |= true_residuals(model, coarse)
    (note,) = polish_notes(entries)
    assert f"{entries['true_mean_abs_f']:.2g}, not {entries['wanted_mean_abs_f']:.2g}" in note
    assert polish_notes(entries | {"wanted_mean_abs_f": entries["true_mean_abs_f"]}) == []


def test_vertices_on_the_box_stay_on_its_faces() -> None:
    cut = load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=6, bounds=[-0.21, 1, -1, 1, -1, 0.17])
    before, after = extract(cut, threads=1), extract(cut, threads=1, polish=True)
    assert before.boundary.size > 0
    for surface in (before, after):
        for axis, face, side in ((0, 0, -0.21), (2, 5, 0.17)):
            tails = surface.corners[surface.box_faces == face]
            assert tails.size > 0
            np.testing.assert_array_equal(surface.vertices[tails, axis], side)
    assert after.report["problems"] == []
    assert after.report["polish"]["mean_abs_f"] < 1e-10


def test_vertices_that_slide_stay_in_the_box() -> None:
    """Faces that fold beside the box, whose vertices slide along the surface to turn them back."""
    network, low, high = dense([8, 8], SINE, seed=0), 0.3 * LOW, 0.3 * HIGH
    canonical, surface = extracted(network, knots=4, lower=low, upper=high)
    moved, result = polish(surface, canonical.network, low, high, threads=1, flatness=ONLY_VERTICES)
    assert result.slid_vertices > 0
    assert (moved.vertices >= low).all()
    assert (moved.vertices <= high).all()


def test_threads_do_not_change_the_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mn_onnx.extract.smooth.projection.BLOCK", 75)
    monkeypatch.setattr("mn_onnx.ir.evaluator.CHUNK", 1 << 13)
    low, high = 0.06 * LOW, 0.06 * HIGH
    canonical, surface = extracted(dense([37, 35], SINE, seed=3), knots=2.5, lower=low, upper=high)
    assert surface.n_vertices > 75 * 16
    meshes = [
        polish(surface, canonical.network, low, high, threads=threads, flatness=ONLY_VERTICES)[0]
        for threads in (1, 2, 3)
    ]
    for mesh in meshes[1:]:
        np.testing.assert_array_equal(meshes[0].vertices, mesh.vertices)


def test_a_function_without_a_gradient_in_places_is_polished_elsewhere() -> None:
    root = apply("sqrt", apply("maximum", T, constant(0.0)))
    canonical, surface = extracted(dense([6], root, seed=2), knots=2)
    assert not np.isfinite(gradient(canonical.network, surface.vertices, true_functions=True)).all()
    moved, entries = polished(surface, canonical, threads=1)
    assert np.isfinite(entries["wanted_mean_abs_f"])
    assert entries["mean_abs_f"] < 0.1 * entries["mean_abs_f_before"]
    assert np.isfinite(moved.vertices).all()
    assert 0 <= certified(surface, canonical, threads=1)[1]["turned_share"] <= 1


def test_nothing_cannot_be_polished(before: Surface, model: Model) -> None:
    nothing = replace(
        before,
        vertices=np.zeros((0, 3)),
        offsets=np.zeros(1, np.int64),
        corners=before.corners[:0],
        twins=before.twins[:0],
        box_faces=before.box_faces[:0],
        gradients=before.gradients[:0],
        errors=before.errors[:0],
        attributes={},
    )
    with pytest.raises(ValueError, match="without polygons"):
        polish(nothing, model.network, LOW, HIGH, threads=1)


def test_no_face_turns_over(model: Model, before: Surface) -> None:
    """Of a mesh that was folded on purpose, no face that was upright turns over, and most others turn back."""
    rng = np.random.default_rng(0)
    shaken = replace(before, vertices=before.vertices + rng.normal(size=before.vertices.shape) * 0.02)
    upright = facing(model.network, shaken) > 0
    assert 0 < np.count_nonzero(~upright) < 0.5 * upright.size
    moved, result = polish(shaken, model.network, LOW, HIGH, threads=1, flatness=ONLY_VERTICES)
    after = facing(model.network, moved)
    assert (after[upright] >= 0).all()
    assert result.turned_polygons == np.count_nonzero(~upright)
    assert result.reversed_polygons == np.count_nonzero(after < 0) <= 0.2 * result.turned_polygons
    assert result.slid_vertices > 0


def test_a_coarse_sine_network_is_polished_without_turning_faces() -> None:
    """Surrogates that are far off: gradients differ by tens of degrees, and vertices move by many polygons."""
    network = dense([8, 8], SINE, seed=4)
    canonical, surface = extracted(network, knots=5, lower=0.3 * LOW, upper=0.3 * HIGH)
    upright = facing(canonical.network, surface) > 0
    moved, result = polish(surface, canonical.network, 0.3 * LOW, 0.3 * HIGH, threads=1, flatness=ONLY_VERTICES)
    assert (facing(canonical.network, moved)[upright] >= 0).all()
    assert result.mean_abs_f < 0.05 * result.mean_abs_f_before
    assert check_invariants(moved).problems() == []


def test_topology_that_is_only_the_surrogates_is_told(before: Surface) -> None:
    """Surrogates so coarse that some polygons face away from the true gradient, against fine ones."""
    canonical, surface = extracted(dense([8, 6], SINE, seed=4), knots=2.0, lower=0.4 * LOW, upper=0.4 * HIGH)
    _, certificate = certified(surface, canonical, threads=1)
    assert certificate["turned_share"] > 0
    (note,) = topology_notes(certificate)
    assert f"about {certificate['turned_share']:.2g} of the area" in note
    assert topology_notes(before.report) == []


def test_what_is_not_near_the_level_set_is_told(model: Model, before: Surface) -> None:
    """A network without any level set: every vertex strays."""
    output = model.network.output
    lifted = replace(model.network, output=AffineRow(output.columns, output.weights, output.bias + 10.0))
    _, result = polish(before, lifted, LOW, HIGH, threads=1, flatness=FLATNESS)
    assert result.stray_vertices + result.held_vertices == before.n_vertices
    assert result.vertices_within_1e_6 == result.divided_polygons == 0


def test_exact_networks_have_nothing_to_polish() -> None:
    assert extract(octahedron_model(), threads=1, polish=True).report["polish"] is None
