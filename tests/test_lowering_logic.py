"""Comparison, choice, rounding and casts of data: what stays continuous is lowered, what jumps is refused."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from onnx_models import assert_agrees, float32, int64, model_of, node

from mn_onnx.errors import ModelRefused
from mn_onnx.importer import import_network
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar import simplify

WEIGHTS = {"A": float32(3, 4), "a": float32(4, seed=1), "B": float32(3, 4, seed=2), "v": float32(4, 1, seed=3)}
LAYERS = [
    node("Gemm", ["x", "A", "a"], ["p"], name="first"),
    node("MatMul", ["x", "B"], ["q"], name="second"),
]


def network(*nodes: onnx.NodeProto, opset: int = 17, **constants: float) -> onnx.ModelProto:
    """Affine ``p`` and ``q`` of the point, the given nodes from them to ``h``, and a linear output."""
    numbers = {name: np.float32(value) for name, value in constants.items()}
    return model_of([*LAYERS, *nodes, node("MatMul", ["h", "v"], ["y"])], WEIGHTS | numbers, opset=opset)


CONTINUOUS = {
    "leaky by where": [
        node("Greater", ["p", "zero"], ["c"]),
        node("Mul", ["p", "slope"], ["s"]),
        node("Where", ["c", "p", "s"], ["h"]),
    ],
    "where with swapped comparison": [
        node("Less", ["p", "zero"], ["c"]),
        node("Mul", ["p", "slope"], ["s"]),
        node("Where", ["c", "s", "p"], ["h"]),
    ],
    "relu by mask": [
        node("Greater", ["p", "zero"], ["c"]),
        node("Cast", ["c"], ["m"], to=1),
        node("Mul", ["p", "m"], ["h"]),
    ],
    "absolute value by sign": [node("Sign", ["p"], ["s"]), node("Mul", ["p", "s"], ["h"])],
    "relu by absolute value": [
        node("Abs", ["p"], ["s"]),
        node("Add", ["p", "s"], ["t"]),
        node("Mul", ["t", "half"], ["h"]),
    ],
    "union by where": [node("Less", ["p", "q"], ["c"]), node("Where", ["c", "p", "q"], ["h"])],
    "union by where, other order": [node("GreaterOrEqual", ["q", "p"], ["c"]), node("Where", ["c", "p", "q"], ["h"])],
    "union of nonlinear fields": [
        node("Relu", ["p"], ["r"]),
        node("Abs", ["q"], ["s"]),
        node("LessOrEqual", ["r", "s"], ["c"]),
        node("Where", ["c", "r", "s"], ["h"]),
    ],
    "minimum by absolute difference": [
        node("Sub", ["p", "q"], ["d"]),
        node("Abs", ["d"], ["e"]),
        node("Add", ["p", "q"], ["s"]),
        node("Sub", ["s", "e"], ["t"]),
        node("Mul", ["t", "half"], ["h"]),
    ],
    "clamp by nested where": [
        node("Less", ["p", "low"], ["c"]),
        node("Greater", ["p", "half"], ["d"]),
        node("Where", ["d", "half", "p"], ["t"]),
        node("Where", ["c", "low", "t"], ["h"]),
    ],
    "clamp by logic": [
        node("Less", ["p", "low"], ["c"]),
        node("Greater", ["p", "half"], ["d"]),
        node("Or", ["c", "d"], ["o"]),
        node("Not", ["o"], ["i"]),
        node("Clip", ["p", "low", "half"], ["t"]),
        node("Where", ["i", "p", "t"], ["h"]),
    ],
    "and, xor": [
        node("Greater", ["p", "low"], ["c"]),
        node("Less", ["p", "half"], ["d"]),
        node("And", ["c", "d"], ["i"]),
        node("Xor", ["i", "true"], ["o"]),
        node("Clip", ["p", "low", "half"], ["t"]),
        node("Where", ["o", "t", "p"], ["h"]),
    ],
    "guard against nan": [
        node("IsNaN", ["p"], ["c"]),
        node("Equal", ["p", "p"], ["e"]),
        node("Not", ["e"], ["n"]),
        node("Or", ["c", "n"], ["o"]),
        node("Where", ["o", "half", "p"], ["t"]),
        node("Relu", ["t"], ["h"]),
    ],
    "guard against infinity": [
        node("IsInf", ["p"], ["c"]),
        node("Where", ["c", "half", "p"], ["t"]),
        node("Relu", ["t"], ["h"]),
    ],
    "casts between real types": [
        node("Cast", ["p"], ["t"], to=TensorProto.DOUBLE),
        node("CastLike", ["t", "q"], ["u"]),
        node("Relu", ["u"], ["h"]),
    ],
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_choices_are_exact(name: str) -> None:
    numbers = {"zero": 0.0, "slope": 0.1, "half": 0.5, "low": -0.25}
    model = network(*CONTINUOUS[name], **numbers)
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.asarray(True), "true"))
    imported = assert_agrees(model)
    for unit in imported.network.units:
        assert isinstance(simplify(unit.functions[0]), KnotTable)


JUMPS = {
    "Sign": [node("Sign", ["p"], ["h"], name="culprit")],
    "Round": [node("Round", ["p"], ["h"], name="culprit")],
    "Floor": [node("Floor", ["p"], ["t"], name="culprit"), node("Relu", ["t"], ["h"], name="later")],
    "Ceil": [node("Ceil", ["p"], ["h"], name="culprit")],
    "Mod": [node("Mod", ["p", "half"], ["h"], name="culprit", fmod=1)],
    "Cast to integers": [
        node("Cast", ["p"], ["t"], name="culprit", to=TensorProto.INT32),
        node("Cast", ["t"], ["h"], name="later", to=TensorProto.FLOAT),
    ],
    "Cast to booleans": [
        node("Cast", ["p"], ["t"], name="culprit", to=TensorProto.BOOL),
        node("Cast", ["t"], ["h"], name="later", to=TensorProto.FLOAT),
    ],
    "comparison": [
        node("Greater", ["p", "zero"], ["t"], name="culprit"),
        node("Cast", ["t"], ["h"], name="later", to=TensorProto.FLOAT),
    ],
    "where that does not meet": [
        node("Greater", ["p", "zero"], ["c"], name="culprit"),
        node("Where", ["c", "p", "half"], ["h"], name="later"),
    ],
    "hard threshold": [node("ThresholdedRelu", ["p"], ["h"], name="culprit", alpha=0.5)],
    "hard shrink": [node("Shrink", ["p"], ["h"], name="culprit", lambd=0.5, bias=0.0)],
}


@pytest.mark.parametrize("name", JUMPS)
def test_jumps_are_refused_at_the_node_that_makes_them(name: str) -> None:
    with pytest.raises(ModelRefused) as refused:
        import_network(network(*JUMPS[name], zero=0.0, half=0.5))
    assert [problem.node for problem in refused.value.problems] == ["culprit"]
    assert "not a continuous function" in refused.value.problems[0].reason


def test_binarizer_is_refused_as_a_step() -> None:
    nodes = [*LAYERS, node("Binarizer", ["p"], ["h"], name="culprit", domain="ai.onnx.ml", threshold=0.1)]
    model = model_of([*nodes, node("MatMul", ["h", "v"], ["y"])], WEIGHTS, domains=["ai.onnx.ml"])
    with pytest.raises(ModelRefused, match=r"culprit \(ai\.onnx\.ml::Binarizer"):
        import_network(model)


@pytest.mark.parametrize("op", ["Mul", "Div"])
def test_products_of_different_functions_are_refused(op: str) -> None:
    with pytest.raises(ModelRefused) as refused:
        import_network(network(node(op, ["p", "q"], ["h"], name="culprit")))
    (problem,) = refused.value.problems
    assert (problem.node, problem.op, problem.opset) == ("culprit", op, 17)
    assert "bind" in problem.remedy


def test_products_of_one_direction_are_functions_of_it() -> None:
    nodes = [node("Mul", ["p", "two"], ["t"]), node("Sigmoid", ["t"], ["s"]), node("Mul", ["p", "s"], ["h"])]
    imported = assert_agrees(network(*nodes, two=2.0))
    assert len(imported.network.units) == 4
    assert len({unit.functions[0] for unit in imported.network.units}) == 1


def test_units_carry_the_names_of_their_nodes() -> None:
    nodes = [node("Relu", ["p"], ["r"], name="/net/act"), node("Max", ["r", "q"], ["h"], name="/net/max")]
    names = [unit.name for unit in assert_agrees(network(*nodes)).network.units]
    assert names[:2] == ["/net/act[0]", "/net/act[1]"]
    assert all(name.startswith(("/net/act[", "/net/max[")) for name in names)


@pytest.mark.parametrize("op", ["Mul", "Add"])
def test_long_chains_of_one_number_stay_small(op: str) -> None:
    """Every step doubles the expression; long ones are cut by units, so that the import does not explode."""
    nodes = []
    name = "p"
    for i in range(24):
        nodes.append(node("Sigmoid", [name], [f"s{i}"]))
        nodes.append(node(op, [name, f"s{i}"], [f"t{i}"]))
        nodes.append(node("Clip", [f"t{i}", "low", "high"], [f"u{i}"]))
        name = f"u{i}"
    nodes.append(node("Identity", [name], ["h"]))
    imported = assert_agrees(network(*nodes, low=-3.0, high=3.0))
    assert 4 < len(imported.network.units) < 400


def test_chains_through_narrow_layers_stay_small() -> None:
    nodes = [node("ReduceSum", ["p", "axes"], ["r0"], keepdims=1)]
    for i in range(20):
        nodes.append(node("Tanh", [f"r{i}"], [f"s{i}"]))
        nodes.append(node("Mul", [f"s{i}", f"r{i}"], [f"m{i}"]))
        nodes.append(node("MatMul", [f"m{i}", "narrow"], [f"r{i + 1}"]))
    nodes.append(node("Expand", ["r20", "shape"], ["h"]))
    constants = WEIGHTS | {"axes": int64(1), "narrow": np.array([[1.7]], np.float32), "shape": int64(1, 4)}
    assert_agrees(model_of([*LAYERS, *nodes, node("MatMul", ["h", "v"], ["y"])], constants))
