"""Corners of the standard that onnx's reference evaluator, or a first reading, gets wrong: as onnxruntime has them."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import TensorProto
from onnx_models import assert_agrees, float32, int64, model_of, node

from mn_onnx.errors import ModelRefused, UsageError
from mn_onnx.model import load
from mn_onnx.reader import read_model

ONES = np.ones((6, 1), np.float32)


def affine(*rest: onnx.NodeProto, width: int = 6, opset: int = 17, **constants: Any) -> onnx.ModelProto:
    """``h = x @ W`` with so many columns, then the given nodes."""
    weights = {"W": float32(3, width)}
    return model_of([node("MatMul", ["x", "W"], ["h"]), *rest], weights | constants, opset=opset)


@pytest.mark.parametrize(("start", "end", "step"), [(-100, -1000, -1), (5, -1000, -2), (100, 1, -1), (-2, 100, 1)])
def test_slices_are_clamped_to_the_axis(start: int, end: int, step: int) -> None:
    limits = {"s": int64(start), "e": int64(end), "a": int64(1), "t": int64(step)}
    parts = [node("Slice", ["h", "s", "e", "a", "t"], ["q"]), node("ReduceSum", ["q", "a"], ["y"])]
    assert_agrees(affine(*parts, opset=13, **limits))


@pytest.mark.parametrize("op", ["ReduceSum", "ReduceMean", "ReduceMax", "ReduceL1", "ReduceL2", "ReduceSumSquare"])
def test_reductions_over_no_axes_still_change_every_element(op: str) -> None:
    parts = [node(op, ["h"], ["a"], noop_with_empty_axes=1), node("MatMul", ["a", "V"], ["y"])]
    assert_agrees(affine(*parts, opset=18, V=ONES))


def test_attributes_of_functions_have_defaults() -> None:
    model = onnx.parser.parse_model("""
        <ir_version: 8, opset_import: ["": 17, "local": 1]>
        g (float[N,3] x) => (float[N,1] y) <float[3,1] w = {1, 2, 3}> {
            h = MatMul(x, w)
            y = local.outer<a = 0.3>(h)
        }
        <domain: "local", opset_import: ["": 17, "local": 1]>
        outer <a: float = 0.1, b: float = 0.2> (q) => (r) { s = LeakyRelu<alpha: float = @a>(q)
            t = local.inner(s)
            r = Elu<alpha: float = @b>(t) }
        <domain: "local", opset_import: ["": 17]>
        inner <c: float = 0.7> (q) => (r) { r = LeakyRelu<alpha: float = @c>(q) }
    """)
    assert_agrees(model)


def folded(op: str, constants: dict[str, Any], *, opset: int, shape: tuple[int, ...], **attributes: Any) -> None:
    """``h`` plus the sum of what a node gives for constants."""
    axes = list(range(len(shape)))
    after = [node("ReduceMax", ["g"], ["s"], axes=axes, keepdims=0), node("Add", ["first", "s"], ["y"])]
    parts = [
        node(op, list(constants), ["g"], domain=attributes.pop("domain", ""), **attributes),
        node("MatMul", ["x", "W"], ["first"]),
        *after,
    ]
    model = model_of(parts, {"W": float32(3, 1)} | constants, opset=opset, domains=("com.microsoft",))
    assert_agrees(model)


def test_constants_are_folded_as_onnxruntime_has_them() -> None:
    statistics = {
        "c": float32(4, 6),
        "a": float32(6),
        "b": float32(6, seed=1),
        "m": float32(6, seed=2),
        "v": np.ones(6, "f"),
    }
    folded("BatchNormalization", statistics, opset=11, shape=(4, 6))
    folded("Softmax", {"c": float32(1, 4, 6)}, opset=11, shape=(1, 4, 6), axis=1)
    folded("GlobalMaxPool", {"c": float32(1, 2, 5)}, opset=11, shape=(1, 2, 5))
    folded("LpNormalization", {"c": float32(4, 6)}, opset=11, shape=(4, 6), p=1)
    folded("Gelu", {"c": float32(4, 6)}, opset=17, shape=(4, 6), domain="com.microsoft")
    folded(
        "FusedMatMul",
        {"c": float32(4, 6), "d": float32(6, 2)},
        opset=17,
        shape=(4, 2),
        domain="com.microsoft",
        alpha=0.5,
    )
    folded("MaxPool", {"c": float32(1, 1, 5)}, opset=11, shape=(1, 1, 5), kernel_shape=[2], pads=[1, 0])


@pytest.mark.parametrize(("op", "last"), [("Ceil", ()), ("Floor", ()), ("Cast", (("to", TensorProto.INT64),))])
def test_constants_are_rounded_before_they_jump(op: str, last: tuple[tuple[str, int], ...]) -> None:
    # Whole numbers in float32, but just above or below them in float64.
    a, b = (np.float32(number) for number in {"Ceil": (30, 0.1), "Floor": (10, 0.7), "Cast": (100, 0.29)}[op])
    model = model_of(
        [
            node("Mul", ["a", "b"], ["c"]),
            node(op, ["c"], ["d"], **dict(last)),
            node("Cast", ["d"], ["e"], to=TensorProto.FLOAT),
            node("MatMul", ["x", "w"], ["xw"]),
            node("Mul", ["xw", "e"], ["y"]),
        ],
        {"a": a, "b": b, "w": float32(3, 1)},
    )
    assert_agrees(model)


def test_tensors_inside_branches_may_have_the_names_of_later_ones() -> None:
    true = onnx.parser.parse_graph("t () => (float[M,1] out) { q = Relu(h)\n out = Neg(q) }")
    false = onnx.parser.parse_graph("e () => (float[M,1] out) { out = Identity(h) }")
    nodes = [
        node("MatMul", ["x", "w"], ["h"]),
        node("If", ["yes"], ["out"], then_branch=true, else_branch=false),
        node("Abs", ["out"], ["q"]),
        node("Add", ["q", "h"], ["y"]),
    ]
    model = model_of(nodes, {"w": float32(3, 1), "yes": np.bool_(True)})
    assert_agrees(read_model(model).model)


def test_norms_are_defined_where_the_surrogates_of_squares_are_negative() -> None:
    nodes = [node("ReduceL2", ["x"], ["r"], axes=[1], keepdims=1), node("Sub", ["r", "half"], ["y"])]
    model = model_of(nodes, {"half": np.float32(0.5)}, opset=17)
    assert_agrees(model)
    assert 0.0 < load(model).surrogate_eps < 0.05


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (
            model_of(
                [
                    node("Add", ["W", "b"], ["V"], axis=0, broadcast=1),
                    node("MatMul", ["x", "V"], ["h"]),
                    node("Relu", ["h"], ["y"]),
                ],
                {"W": float32(3, 3), "b": float32(3)},
                opset=6,
            ),
            "its definition before version 7 is not supported",
        ),
        (affine(node("Max", ["h", ""], ["y"]), width=1), "has no name"),
        (affine(node("TopK", ["h", "k"], ["y", "i"], sorted=0), k=int64(1)), "no defined order"),
    ],
    ids=["old definition", "empty input", "unsorted"],
)
def test_refused(model: onnx.ModelProto, reason: str) -> None:
    with pytest.raises(ModelRefused, match=reason):
        load(model)


@pytest.mark.parametrize("value", ["abc", [[1.0], [2.0, 3.0]], None, 1.5, 3e9, -(2**40), float("nan")])
def test_only_numbers_of_the_type_are_bound(value: Any) -> None:
    nodes = [
        node("MatMul", ["x", "w"], ["h"]),
        node("Cast", ["k"], ["f"], to=TensorProto.FLOAT),
        node("Mul", ["h", "f"], ["y"]),
    ]
    model = model_of(nodes, {"w": float32(3, 1)}, inputs={"x": ("N", 3), "k": (1,)}, types={"k": TensorProto.INT32})
    with pytest.raises(UsageError, match="k"):
        load(model, bind={"k": value})
    assert_agrees(model, bind={"k": 2.0})


def test_element_types_that_onnx_does_not_define_are_refused() -> None:
    model = affine(node("Relu", ["h"], ["y"]), width=1)
    model.graph.input[0].type.tensor_type.elem_type = 99
    with pytest.raises(ModelRefused, match="element type 99"):
        load(model)


def test_depth_and_space_change_places_in_either_order() -> None:
    if onnx.defs.onnx_opset_version() < 28:
        pytest.skip("SpaceToDepth has no modes before opset 28")
    parts = [
        node("Reshape", ["h", "grid"], ["g"]),
        node("SpaceToDepth", ["g"], ["d"], blocksize=2, mode="CRD"),
        node("Reshape", ["d", "flat"], ["r"]),
        node("MatMul", ["r", "V"], ["y"]),
    ]
    shapes = {"grid": int64(-1, 2, 2, 4), "flat": int64(-1, 16), "V": float32(16, 1)}
    assert_agrees(affine(*parts, width=16, opset=28, **shapes))
