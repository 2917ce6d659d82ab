"""How far a mesh is said to be from the level set, and what rounding may explain of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from small_models import octahedron_model

import mn_onnx
from mn_onnx.checks.residual import FACE_SAMPLES, measure_residuals
from mn_onnx.checks.verification import verify


@pytest.fixture(scope="module")
def octahedron() -> tuple[mn_onnx.Model, mn_onnx.Surface]:
    model = mn_onnx.load(octahedron_model(), bounds=(-1, 1))
    return model, mn_onnx.extract(model, check=False)


def scaled(model: mn_onnx.Model, factor: float) -> mn_onnx.Model:
    """``model`` with an output ``factor`` times as steep, and the same level set."""
    proto = octahedron_model()
    node = proto.graph.node.add(op_type="Mul", input=["y", "factor"], output=["scaled"], name="scale")
    proto.graph.initializer.add(name=node.input[1], data_type=1, float_data=[factor])
    proto.graph.output[0].name = "scaled"
    return mn_onnx.load(proto, bounds=model.bounds)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_a_file_is_judged_by_the_slope_of_the_field(
    factor: float, octahedron: tuple[mn_onnx.Model, mn_onnx.Surface], tmp_path: Path
) -> None:
    model, surface = octahedron
    mn_onnx.write_mesh(surface, tmp_path / "right.ply")
    moved = dataclasses.replace(surface, vertices=surface.vertices * (1 + 1e-5))
    mn_onnx.write_mesh(moved, tmp_path / "wrong.ply")
    steep = scaled(model, factor)
    assert verify(tmp_path / "right.ply", steep)["problems"] == []
    (problem,) = verify(tmp_path / "wrong.ply", steep)["problems"]
    assert "not the exact level set" in problem


def test_all_vertices_are_measured_where_it_is_asked(octahedron: tuple[mn_onnx.Model, mn_onnx.Surface]) -> None:
    model, surface = octahedron
    assert measure_residuals(model, surface, None, most_vertices=3).points == 3 + FACE_SAMPLES
    vertices = surface.vertices.copy()
    vertices[-1] *= 1.25
    bent = dataclasses.replace(surface, vertices=vertices)
    found = measure_residuals(model, bent, None, most_vertices=None)
    assert found.points == surface.n_vertices + FACE_SAMPLES
    assert found.max_abs_f == pytest.approx(0.25 * 0.5 / 3)
    assert found.worst_ratio > 1e6


def test_vertices_without_polygons_are_not_measured(octahedron: tuple[mn_onnx.Model, mn_onnx.Surface]) -> None:
    model, surface = octahedron
    stray = dataclasses.replace(surface, vertices=np.append(surface.vertices, np.zeros((1, 3)), axis=0))
    assert measure_residuals(model, stray, None).max_abs_f < 1e-13
