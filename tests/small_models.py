"""Small ONNX models with known level sets."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

TILT = np.array([[1.0, 0.013, 0.007], [-0.011, 1.0, 0.017], [0.003, -0.019, 1.0]], np.float32)


def octahedron_model(radius: float = 0.5, *, name: str = "octahedron") -> onnx.ModelProto:
    """(sum_i |(x TILT)_i| - radius) / 3: tilted, so that no knot plane is parallel to a face of the domain."""
    nodes = [
        helper.make_node("MatMul", ["x", "tilt"], ["t"], name="tilt"),
        helper.make_node("Abs", ["t"], ["a"], name="abs"),
        helper.make_node("ReduceMean", ["a"], ["m"], name="mean", axes=[1], keepdims=1),
        helper.make_node("Sub", ["m", "third"], ["y"], name="sub"),
    ]
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(TILT, "tilt"), numpy_helper.from_array(np.array([radius / 3], np.float32), "third")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def octahedron_volume(radius: float = 0.5) -> float:
    """The volume inside the level set of `octahedron_model`."""
    return 4 / 3 * radius**3 / float(np.linalg.det(TILT.astype(np.float64)))


def shifted_model() -> onnx.ModelProto:
    """`octahedron_model` with an input more, and an output ``fields``: the point, then ``y + shift``."""
    model = octahedron_model()
    graph = model.graph
    graph.input.append(helper.make_tensor_value_info("shift", TensorProto.FLOAT, [1]))
    graph.node.append(helper.make_node("Add", ["y", "shift"], ["s"], name="shift"))
    graph.node.append(helper.make_node("Concat", ["x", "s"], ["fields"], name="join", axis=1))
    graph.output.append(helper.make_tensor_value_info("fields", TensorProto.FLOAT, ["N", 4]))
    return model


def refused_model() -> onnx.ModelProto:
    """`octahedron_model` followed by products of coordinates, in two nodes."""
    model = octahedron_model()
    graph = model.graph
    graph.node.append(helper.make_node("Mul", ["x", "t"], ["p"], name="product"))
    graph.node.append(helper.make_node("Sqrt", ["p"], ["q"], name="root"))
    graph.node.append(helper.make_node("Mul", ["a", "x"], ["r"], name="second_product"))
    graph.node.append(helper.make_node("Add", ["p", "r"], ["sum"], name="sum"))
    graph.node.append(helper.make_node("ReduceSum", ["sum"], ["z"], name="total", keepdims=1))
    del graph.output[:]
    graph.output.append(helper.make_tensor_value_info("z", TensorProto.FLOAT, None))
    return model
