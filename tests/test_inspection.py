"""What ``inspect`` tells before any work, beside what extraction finds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx_models import float32, model_of, node
from smooth_models import soft_octahedron_model

from mn_onnx.cli import main
from mn_onnx.errors import ModelRefused
from mn_onnx.extraction import extract
from mn_onnx.inspection import as_text, describe
from mn_onnx.model import load

SAME = (
    "output", "level", "bounds", "exact", "sign", "bounds_from", "surrogate_eps", "knots_per_period",
    "forecast_polygons", "output_range",
)  # fmt: skip


def test_predictions_hold() -> None:
    options = {"bind": {"code": [0.0]}, "knots_per_period": 8, "bounds": (-0.9, 0.9)}
    description = describe(load(soft_octahedron_model(), **options))
    report = extract(soft_octahedron_model(), threads=1, **options).report
    assert {key: description[key] for key in SAME} == {key: report[key] for key in SAME}
    assert description["forecast_polygons"] == pytest.approx(report["polygons"], rel=0.3)
    assert description["output_range"][0] < 0 < description["output_range"][1]
    assert "polygons at 8 knots per period" in as_text(description)
    assert "[-0.9, 0.9] x [-0.9, 0.9] x [-0.9, 0.9], as asked for" in as_text(description)


def test_the_box_of_the_metadata_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = soft_octahedron_model()
    onnx.helper.set_model_props(model, {"bounds": "-1.5 1.5"})
    onnx.save(model, tmp_path / "model.onnx")
    options = [str(tmp_path / "model.onnx"), "--bind", "code=0", "--knots-per-period", "2"]
    assert main(["inspect", *options]) == 0
    assert main(["extract", *options, "-o", str(tmp_path / "mesh.ply")]) == 0
    assert capsys.readouterr().out.count("[-1.5, 1.5] x [-1.5, 1.5] x [-1.5, 1.5], from the model's metadata") == 2


def test_heads_are_told_beside_the_errors_before_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """After Exp, errors of the output are larger than those that are proved, which are of what goes into it."""
    model = soft_octahedron_model(scale=3.0)
    model.graph.node.append(node("Exp", ["y"], ["grown"], name="head"))
    model.graph.output[0].name = "grown"
    onnx.save(model, tmp_path / "model.onnx")
    options = [str(tmp_path / "model.onnx"), "--bind", "code=0", "--knots-per-period", "2", "--level", "20"]
    assert main(["inspect", *options]) == 0
    assert "heads        head[0], inverted at the level" in capsys.readouterr().out
    assert main(["extract", *options, "-o", str(tmp_path / "mesh.ply"), "--report", str(tmp_path / "report")]) == 0
    assert "of the true network before head[0]; |output - level|" in capsys.readouterr().out
    report = json.loads((tmp_path / "report").read_text())
    assert report["heads"] == ["head[0]"]
    assert report["true_max_abs_f"] > report["surrogate_eps"]


def sinc_model(*, guarded: bool = False, softened: bool = False) -> onnx.ModelProto:
    """A layer of sin(t)/t, plain, with its value at zero filled in, or over s = sqrt(t^2 + 1e-8)."""
    nodes = [node("MatMul", ["x", "W"], ["r" if not softened else "t"])]
    if softened:
        nodes += [node("Mul", ["t", "t"], ["t2"]), node("Add", ["t2", "e"], ["t3"]), node("Sqrt", ["t3"], ["r"])]
    nodes += [node("Sin", ["r"], ["s"]), node("Div", ["s", "r"], ["q"], name="sinc")]
    if guarded:
        nodes += [node("Equal", ["r", "zero"], ["at_zero"]), node("Where", ["at_zero", "one", "q"], ["w"])]
    nodes.append(node("MatMul", ["w" if guarded else "q", "O"], ["y"]))
    constants = {
        "W": float32(3, 4), "O": float32(4, 1), "e": np.float32(1e-8), "zero": np.float32(0), "one": np.float32(1)
    }  # fmt: skip
    return model_of(nodes, constants)


@pytest.mark.parametrize("guarded", [False, True])
def test_gaps_that_could_be_filled_are_refused_with_a_way_out(guarded: bool) -> None:
    with pytest.raises(ModelRefused) as caught:
        load(sinc_model(guarded=guarded))
    assert "sqrt(t*t + 1e-8)" in str(caught.value)
    assert not load(sinc_model(softened=True)).exact
