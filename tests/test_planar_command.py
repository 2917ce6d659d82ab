"""Curves and roots through the library's front end and the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx_models import model_of, node

import mn_onnx
from mn_onnx.cli import EXIT_CHECK, EXIT_USAGE, main
from mn_onnx.extract.planar.curve import Curve, Roots
from oracle.sketch import Sketch, as_onnx


def ball(radius: float, dimension: int) -> onnx.ModelProto:
    """|x_0| + ... - radius: a diamond over two coordinates, an interval over one."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        return sketch.affine(sketch.abs(x), np.ones((1, dimension)), [-radius])

    return as_onnx(body, dimension)


def saved(model: onnx.ModelProto, folder: Path) -> str:
    path = folder / "model.onnx"
    path.write_bytes(model.SerializeToString())
    return str(path)


def test_diamond() -> None:
    found = mn_onnx.extract_planar(ball(0.5, 2))
    assert isinstance(found.level_set, Curve)
    report = found.report
    assert (report["polylines"], report["segments"], report["closed"]) == (1, 4, True)
    assert report["area"] == pytest.approx(0.5, abs=1e-12)
    assert report["length"] == pytest.approx(4 * np.hypot(0.5, 0.5), abs=1e-12)
    assert report["max_abs_f"] < 1e-15
    assert report["ort_mean_abs_f"] < 1e-7
    assert report["parity_max_abs_err"] <= report["parity_allowed_err"]


def test_roots_of_an_interval() -> None:
    found = mn_onnx.extract_planar(ball(0.25, 1), level=0.25)
    assert isinstance(found.level_set, Roots)
    np.testing.assert_allclose(found.points, [[-0.5], [0.5]], atol=1e-15)
    assert found.level_set.slopes.tolist() == [-1, 1]


def test_a_field_in_space_is_left_to_extract() -> None:
    with pytest.raises(mn_onnx.UsageError, match="over 3 coordinates: use extract"):
        mn_onnx.extract_planar(ball(0.5, 3))
    with pytest.raises(mn_onnx.UsageError, match="extract_planar"):
        mn_onnx.extract(ball(0.5, 2))


@pytest.mark.parametrize("ending", ["svg", "json", "npz"])
def test_command_writes_a_curve(ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, report = tmp_path / f"diamond.{ending}", tmp_path / "report.json"
    model = saved(ball(0.5, 2), tmp_path)
    assert main(["extract", model, "-o", str(target), "--report", str(report)]) == 0
    assert "1 polylines of 4 segments" in capsys.readouterr().out
    assert json.loads(report.read_text())["closed"] is True
    if ending == "json":
        (polyline,) = json.loads(target.read_text())["polylines"]
        assert polyline["closed"]
        assert np.abs(polyline["points"]).sum(axis=1) == pytest.approx([0.5] * 4)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["model.onnx", target.name, "report.json"])


@pytest.mark.parametrize("ending", ["json", "npz"])
def test_command_writes_roots(ending: str, tmp_path: Path) -> None:
    target = tmp_path / f"roots.{ending}"
    assert main(["extract", saved(ball(0.5, 1), tmp_path), "-o", str(target), "--quiet"]) == 0
    stored = json.loads(target.read_text()) if ending == "json" else np.load(target)
    np.testing.assert_allclose(stored["positions"], [-0.5, 0.5])
    np.testing.assert_allclose(stored["slopes"], [-1, 1])


@pytest.mark.parametrize(("dimension", "name"), [(2, "curve.ply"), (1, "roots.svg"), (3, "mesh.svg")])
def test_command_refuses_files_that_cannot_hold_the_level_set(
    dimension: int, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = saved(ball(0.5, dimension), tmp_path)
    assert main(["extract", model, "-o", str(tmp_path / name)]) == EXIT_USAGE
    assert "written to" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_command_reports_an_empty_level_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = saved(ball(3, 2), tmp_path)
    assert main(["extract", model, "-o", str(tmp_path / "curve.svg")]) == EXIT_CHECK
    assert "the level set is empty" in capsys.readouterr().err
    assert not (tmp_path / "curve.svg").exists()


def test_options_of_meshes_are_refused_for_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "curve.svg"
    arguments = ["extract", saved(ball(0.5, 2), tmp_path), "-o", str(target), "--float64", "--polish"]
    assert main(arguments) == EXIT_USAGE
    assert "--float64, --polish: only for meshes" in capsys.readouterr().err
    assert not target.exists()


def test_a_loaded_model_takes_no_further_options() -> None:
    model = mn_onnx.load(ball(0.5, 2))
    with pytest.raises(mn_onnx.UsageError, match="loaded already: give level to load"):
        mn_onnx.extract_planar(model, level=0.1)


def test_rounding_of_points_taken_back_is_no_fault() -> None:
    """|leaky(2 x + 2 y - 1)| = |leaky(1 - 2 y)|: perturbed, points move far, and with them rounding errors."""
    nodes = [
        node("Gemm", ["x", "W", "b"], ["h"]),
        node("LeakyRelu", ["h"], ["l"]),
        node("Abs", ["l"], ["a"]),
        node("Gemm", ["a", "O", "one"], ["g"]),
        node("Relu", ["g"], ["r"]),
        node("Sub", ["r", "one"], ["y"]),
    ]
    constants = {
        "W": np.array([[-2, 0], [-2, -2]], np.float32),
        "b": np.ones(2, np.float32),
        "O": np.array([[-1], [1]], np.float32),
        "one": np.ones(1, np.float32),
    }
    found = mn_onnx.extract_planar(model_of(nodes, constants, inputs={"x": ("N", 2)}))
    assert found.report["problems"] == []
    assert found.report["max_abs_f"] < 1e-12
