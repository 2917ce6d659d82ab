"""Sign conventions, and one mesh for each row of codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from ir_networks import TANH, dense
from onnx_models import float32, int64, model_of, node, points_in_box, runtime_values
from smooth_models import soft_octahedron_model

import mn_onnx.field
from mn_onnx.cli import main
from mn_onnx.errors import UsageError
from mn_onnx.extract.files import read_mesh
from mn_onnx.extraction import extract
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.substitute import with_fixed_inputs
from mn_onnx.model import load
from mn_onnx.series import Series, count_rows, numbered, row_of


@pytest.mark.parametrize(("scale", "sign"), [(1.0, "positive-outside"), (-1.0, "positive-inside")])
def test_sign_is_found_at_the_corners(scale: float, sign: str) -> None:
    surface = extract(
        soft_octahedron_model(scale=scale), bind={"code": [0.0]}, knots_per_period=4, threads=1, budget=1e5
    )
    assert surface.report["sign"] == sign
    assert surface.volume is not None
    assert surface.volume > 0


def test_a_sign_that_is_given_decides() -> None:
    options = {"bind": {"code": [0.0]}, "knots_per_period": 4}
    wrong = extract(soft_octahedron_model(), sign="positive-inside", threads=1, **options)
    assert wrong.volume is not None
    assert wrong.volume < 0
    with pytest.raises(UsageError, match="positive-outside"):
        load(soft_octahedron_model(), sign="inside", **options)


def test_one_mesh_for_each_row(tmp_path: Path) -> None:
    model, codes = tmp_path / "model.onnx", tmp_path / "codes.npy"
    onnx.save(soft_octahedron_model(), model)
    np.save(codes, np.array([[0.0], [0.4], [0.8]]))
    command = ["extract", str(model), "-o", str(tmp_path / "m_{:02d}.ply"), "--bind", f"code={codes}", "--all"]
    assert main([*command, "--knots-per-period", "4", "--quiet", "--report", str(tmp_path / "r.json")]) == 0
    areas = [read_mesh(tmp_path / f"m_{row:02d}.ply").area for row in range(3)]
    assert areas[0] > areas[1] > areas[2] > 0
    assert json.loads((tmp_path / "r-2.json").read_text())["closed"]


def coded_model(*, film: bool = False) -> onnx.ModelProto:
    """A network of points [N, 3] and a code [1, 4]: the code is joined to the point, or scales the features."""
    nodes = [node("MatMul", ["code", "C"], ["c"]), node("Relu", ["c"], ["shift"])]
    if film:
        nodes += [node("MatMul", ["x", "W"], ["h"]), node("Mul", ["h", "shift"], ["t"])]
    else:
        nodes += [
            node("Shape", ["x"], ["size"], start=0, end=1),
            node("Concat", ["size", "width"], ["rows"], axis=0),
            node("Expand", ["shift", "rows"], ["codes"]),
            node("Concat", ["x", "codes"], ["joined"], axis=1),
            node("MatMul", ["joined", "V"], ["t"]),
        ]
    nodes += [node("Softplus", ["t"], ["a"]), node("MatMul", ["a", "O"], ["y"])]
    constants = {
        "C": float32(4, 8), "W": float32(3, 8), "V": float32(11, 8), "O": float32(8, 1), "width": int64(8)
    }  # fmt: skip
    return model_of(nodes, constants, inputs={"x": ("N", 3), "code": (1, 4)})


@pytest.mark.parametrize("film", [False, True])
def test_rows_are_the_models_of_their_codes(film: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []
    monkeypatch.setattr(
        "mn_onnx.importer.choose_output", lambda *args: runs.append(args) or mn_onnx.field.choose_output(*args)
    )
    codes = np.random.default_rng(0).normal(size=(4, 4))
    series = Series(coded_model(film=film), bind={"code": codes}, knots_per_period=4, level=0.3)
    points = points_in_box(3)
    models = [series.model(row) for row in range(series.n_rows)]
    # The graph is run with two batch sizes: once for all rows, or for each where codes are multiplied with the point.
    assert len(runs) == (1 + 2 * len(codes) if film else 2)
    for code, model in zip(codes, models, strict=True):
        alone = load(coded_model(film=film), bind={"code": code}, knots_per_period=4, level=0.3)
        np.testing.assert_allclose(model.evaluate(points), alone.evaluate(points), atol=1e-13)
        np.testing.assert_allclose(
            runtime_values(coded_model(film=film), model.imported, points), model.evaluate(points), atol=1e-4
        )


def test_fixed_inputs_of_a_network() -> None:
    network = dense([6, 5], TANH, dimension=5, seed=2)
    values = np.array([0.25, -0.5])
    fixed = with_fixed_inputs(network, values)
    points = points_in_box(3)
    together = np.concatenate([points, np.tile(values, (len(points), 1))], axis=1)
    np.testing.assert_allclose(
        evaluate(fixed, points, true_functions=True), evaluate(network, together, true_functions=True), atol=1e-14
    )
    with pytest.raises(ValueError, match="leave none"):
        with_fixed_inputs(network, np.zeros(5))


def test_rows_of_tables() -> None:
    bound = {"code": np.arange(6.0).reshape(3, 2), "time": np.float64(0.5).reshape(())}
    assert count_rows(bound) == 3
    assert row_of(bound, 1)["code"].tolist() == [2.0, 3.0]
    assert row_of(bound, 1)["time"] == 0.5
    with pytest.raises(UsageError, match="rows 0 to 2"):
        row_of(bound, 3)
    with pytest.raises(UsageError, match="need a table"):
        count_rows({"time": bound["time"]})
    with pytest.raises(UsageError, match="different numbers of rows"):
        count_rows({**bound, "other": np.zeros((2, 2))})


def test_names_of_numbered_files() -> None:
    assert numbered("mesh_{:03d}.ply", 10)[7] == "mesh_007.ply"
    assert numbered("out/mesh.ply", 12)[7] == "out/mesh-07.ply"
    with pytest.raises(UsageError, match="03d"):
        numbered("mesh_{name}.ply", 10)
