"""Models that are well formed and still have no surface to extract, or cannot be compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from small_models import octahedron_model

import mn_onnx
from mn_onnx.cli import EXIT_USAGE, main


def test_field_that_is_the_level_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A network of zero weights, as exporters write one that never was trained."""
    weights = [
        numpy_helper.from_array(np.zeros(shape, np.float32), name) for name, shape in (("w", (8, 3)), ("v", (1, 8)))
    ]
    nodes = [
        helper.make_node("Gemm", ["x", "w"], ["t"], name="first", transB=1),
        helper.make_node("Relu", ["t"], ["a"], name="relu"),
        helper.make_node("Gemm", ["a", "v"], ["f"], name="last", transB=1),
    ]
    points = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 3])
    field = helper.make_tensor_value_info("f", TensorProto.FLOAT, ["N", 1])
    graph = helper.make_graph(nodes, "zeros", [points], [field], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path = tmp_path / "zeros.onnx"
    path.write_bytes(model.SerializeToString())
    assert main(["extract", str(path), "-o", str(tmp_path / "mesh.ply")]) == EXIT_USAGE
    assert "everywhere in the box" in capsys.readouterr().err
    assert not (tmp_path / "mesh.ply").exists()
    assert mn_onnx.extract(model, level=1.0).n_polygons == 0


def test_batch_too_large_to_run_for_comparison() -> None:
    model = octahedron_model()
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 2**40
    with pytest.raises(mn_onnx.ModelRefused, match=r"1,099,511,627,776 points at once.*\n.*free batch axis"):
        mn_onnx.extract(model)
    surface = mn_onnx.extract(model, check=False)
    assert surface.n_polygons == 8
