"""Random graphs of piecewise-linear and smooth operators against onnx's reference evaluator in float64."""

from __future__ import annotations

import numpy as np
import onnx
import onnx.reference
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto
from onnx_models import imported_values, int64, model_of, node, points_in_box

from mn_onnx.importer import import_network

UNARY = ["Relu", "LeakyRelu", "Abs", "Neg", "Sigmoid", "Tanh", "Softplus", "Elu", "HardSigmoid", "Identity", "Sin"]
BINARY = ["Add", "Sub", "Max", "Min", "Mean"]


class GraphBuilder:
    """A graph on tensors [N, width], grown by one operator at a time."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}
        self.tensors = [("x", 3)]

    def constant(self, *shape: int) -> str:
        name = f"c{len(self.constants)}"
        # Few digits, so that equal rows, ties and cancellations occur.
        self.constants[name] = np.round(self.random.normal(size=shape), 1)
        return name

    def add(self, op: str, inputs: list[str], width: int, **attributes: object) -> tuple[str, int]:
        name = f"t{len(self.nodes)}"
        self.nodes.append(node(op, inputs, [name], **attributes))
        self.tensors.append((name, width))
        return self.tensors[-1]

    def grow(self, kind: str) -> None:
        name, width = self.tensors[self.random.integers(len(self.tensors))]
        other, other_width = self.tensors[self.random.integers(len(self.tensors))]
        if kind == "unary":
            self.add(str(self.random.choice(UNARY)), [name], width)
        elif kind == "binary":
            if width != other_width:
                other, _ = self.add("MatMul", [other, self.constant(other_width, width)], width)
            self.add(str(self.random.choice(BINARY)), [name, other], width)
        elif kind == "layer":
            wide = int(self.random.integers(1, 5))
            self.add("Gemm", [name, self.constant(width, wide), self.constant(wide)], wide)
        elif kind == "scale":
            factor, _ = self.add("Mul", [name, self.constant(1, width)], width)
            self.add("Add", [factor, self.constant(1)], width)
        elif kind == "gate":
            gate, _ = self.add("Sigmoid", [name], width)
            self.add("Mul", [name, gate], width)
        elif kind == "where":
            if width != other_width:
                other, _ = self.add("MatMul", [other, self.constant(other_width, width)], width)
            less = f"b{len(self.nodes)}"
            self.nodes.append(node("Less", [name, other], [less]))
            self.add("Where", [less, name, other], width)
        elif kind == "concat":
            self.add("Concat", [name, other], width + other_width, axis=1)
        else:
            index = f"i{len(self.constants)}"
            self.constants[index] = self.random.integers(-width, width, 3)
            self.add("Gather", [name, index], 3, axis=1)

    def model(self) -> onnx.ModelProto:
        name, width = self.tensors[-1]
        self.add("MatMul", [name, self.constant(width, 1)], 1)
        last = self.tensors[-1][0]
        self.nodes.append(node("Identity", [last], ["y"]))
        types = {"x": TensorProto.DOUBLE, "y": TensorProto.DOUBLE}
        return model_of(self.nodes, self.constants | {"unused": int64(0)}, types=types)


KINDS = ["unary", "unary", "binary", "layer", "layer", "scale", "gate", "where", "concat", "gather"]


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.lists(st.sampled_from(KINDS), min_size=2, max_size=14))
def test_random_graph_agrees_with_the_reference_evaluator(seed: int, kinds: list[str]) -> None:
    builder = GraphBuilder(seed)
    for kind in kinds:
        builder.grow(kind)
    model = builder.model()
    points = points_in_box(3)
    expected = onnx.reference.ReferenceEvaluator(model).run(None, {"x": points})[0][:, 0]
    actual = imported_values(import_network(model), points)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-10 * max(1.0, np.abs(expected).max()))
