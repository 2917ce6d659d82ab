"""Small ONNX models with smooth activations."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from small_models import TILT

from mn_onnx.extract.pipeline import extract_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.passes import Canonical, canonicalize

LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)


def soft_octahedron_model(beta: float = 8.0, *, scale: float = 1.0) -> onnx.ModelProto:
    """``scale * (sum_i softplus(beta t_i) + softplus(-beta t_i) + code) / beta - 0.7 scale``: round where |t| bends.

    ``code``: an input [1] that makes the shape smaller.
    """
    nodes = [
        helper.make_node("MatMul", ["x", "tilt"], ["t"], name="tilt"),
        helper.make_node("Softplus", ["t"], ["s"], name="softplus"),
        helper.make_node("ReduceSum", ["s", "axis"], ["sum"], name="sum", keepdims=1),
        helper.make_node("Add", ["sum", "code"], ["shrunk"], name="shrink"),
        helper.make_node("Mul", ["shrunk", "share"], ["scaled"], name="scale"),
        helper.make_node("Sub", ["scaled", "radius"], ["y"], name="level"),
    ]
    tilt = np.concatenate([TILT, -TILT], axis=1) * np.float32(beta)
    graph = helper.make_graph(
        nodes,
        "soft_octahedron",
        [
            helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 3]),
            helper.make_tensor_value_info("code", TensorProto.FLOAT, [1]),
        ],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", 1])],
        [
            numpy_helper.from_array(tilt, "tilt"),
            numpy_helper.from_array(np.array([1]), "axis"),
            numpy_helper.from_array(np.array([scale / beta], np.float32), "share"),
            numpy_helper.from_array(np.array([0.7 * scale], np.float32), "radius"),
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def extracted(
    network: Network, *, knots: float, lower: Floats = LOW, upper: Floats = HIGH
) -> tuple[Canonical, Surface]:
    """The canonical form of ``network`` and its level set through the middle of the box."""
    level = float(evaluate(network, 0.5 * (lower + upper)[None, :], true_functions=True)[0])
    canonical = canonicalize(network, lower=lower, upper=upper, level=level, knots_per_period=knots)
    return canonical, extract_surface(canonical.network, lower, upper, threads=1).surface
