"""A model must be a function of one point: whatever depends on the rest of the batch is refused, by name."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from onnx_models import assert_agrees, float32, int64, model_of, node

from mn_onnx.errors import ModelRefused
from mn_onnx.importer import import_network

W = float32(3, 1)
CLOUD = {"x": (1, "N", 3)}


def refused(model: onnx.ModelProto, **options: object) -> list[str]:
    """Nodes of the problems of a model that must be refused."""
    with pytest.raises(ModelRefused) as error:
        import_network(model, **options)  # type: ignore[arg-type]
    assert all(problem.reason and problem.remedy for problem in error.value.problems)
    return [problem.node for problem in error.value.problems]


MIXING: dict[str, tuple[list[onnx.NodeProto], dict[str, np.ndarray], dict[str, tuple[int | str, ...]]]] = {
    "two points in one row": (
        [node("Reshape", ["x", "s"], ["r"]), node("MatMul", ["r", "w"], ["y"], name="culprit")],
        {"s": int64(-1, 6), "w": float32(6, 1)},
        {"x": ("N", 3)},
    ),
    "two points in one row, static batch": (
        [node("Reshape", ["x", "s"], ["r"]), node("MatMul", ["r", "w"], ["y"], name="culprit")],
        {"s": int64(-1, 6), "w": float32(6, 1)},
        {"x": (4, 3)},
    ),
    "mean over the batch": (
        [
            node("ReduceMean", ["x"], ["m"], name="culprit", axes=[0], keepdims=1),
            node("Sub", ["x", "m"], ["d"]),
            node("MatMul", ["d", "w"], ["y"]),
        ],
        {"w": W},
        {"x": ("N", 3)},
    ),
    "maximum over the batch": (
        [
            node("MatMul", ["x", "w"], ["h"]),
            node("ReduceMax", ["h"], ["m"], name="culprit", axes=[0]),
            node("Sub", ["h", "m"], ["y"]),
        ],
        {"w": W},
        {"x": ("N", 3)},
    ),
    "convolution over the points": (
        [node("Transpose", ["x"], ["t"], perm=[0, 2, 1]), node("Conv", ["t", "w"], ["y"], name="culprit", pads=[1, 1])],
        {"w": float32(1, 3, 3)},
        CLOUD,
    ),
    "pool over the points": (
        [
            node("Transpose", ["x"], ["t"], perm=[0, 2, 1]),
            node("MaxPool", ["t"], ["m"], name="culprit", kernel_shape=[3], pads=[1, 1]),
            node("Conv", ["m", "w"], ["y"]),
        ],
        {"w": float32(1, 3, 1)},
        CLOUD,
    ),
    "attention over the points": (
        [
            node("Transpose", ["x"], ["t"]),
            node("MatMul", ["x", "t"], ["a"], name="culprit"),
            node("Softmax", ["a"], ["s"]),
            node("MatMul", ["s", "x"], ["o"]),
            node("MatMul", ["o", "w"], ["y"]),
        ],
        {"w": W},
        {"x": ("N", 3)},
    ),
    "cumulative sum over the points": (
        [node("CumSum", ["x", "a"], ["c"], name="culprit"), node("MatMul", ["c", "w"], ["y"])],
        {"a": np.int64(0), "w": W},
        {"x": ("N", 3)},
    ),
    "one sum for all points": (
        [node("MatMul", ["x", "w"], ["h"]), node("ReduceSum", ["h"], ["y"], name="culprit", keepdims=0)],
        {"w": W},
        {"x": ("N", 3)},
    ),
    "division by the number of points": (
        [
            node("Shape", ["x"], ["s"]),
            node("Gather", ["s", "zero"], ["n"]),
            node("Cast", ["n"], ["real"], to=TensorProto.FLOAT),
            node("MatMul", ["x", "w"], ["h"]),
            node("Div", ["h", "real"], ["y"], name="culprit"),
        ],
        {"zero": np.int64(0), "w": W},
        {"x": ("N", 3)},
    ),
    "number of the point": (
        [
            node("Shape", ["x"], ["s"]),
            node("Gather", ["s", "zero"], ["n"]),
            node("Range", ["zero", "n", "one"], ["r"]),
            node("Cast", ["r"], ["real"], to=TensorProto.FLOAT),
            node("MatMul", ["x", "w"], ["h"]),
            node("Squeeze", ["h", "axes"], ["f"]),
            node("Add", ["f", "real"], ["y"], name="culprit"),
        ],
        {"zero": np.int64(0), "one": np.int64(1), "axes": int64(1), "w": W},
        {"x": ("N", 3)},
    ),
}


@pytest.mark.parametrize("name", MIXING)
def test_mixing_of_points_is_refused(name: str) -> None:
    nodes, constants, inputs = MIXING[name]
    assert refused(model_of(nodes, constants, inputs=inputs)) == ["culprit"]


@pytest.mark.parametrize(
    "rows", [("first", int64(0), int64(1), int64(1)), ("reversed", int64(-1), int64(-9999), int64(-1))]
)
def test_outputs_that_are_not_one_value_per_point_in_order(
    rows: tuple[str, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    _, start, end, step = rows
    nodes = [node("Slice", ["x", "s", "e", "a", "t"], ["part"]), node("MatMul", ["part", "w"], ["y"])]
    assert refused(model_of(nodes, {"s": start, "e": end, "a": int64(0), "t": step, "w": W})) == ["output 'y'"]


def test_mixing_that_the_output_does_not_see_is_allowed() -> None:
    nodes = [
        node("ReduceMean", ["x"], ["mean"], axes=[0]),
        node("Mul", ["mean", "zero"], ["nothing"]),
        node("MatMul", ["x", "w"], ["y"]),
        node("Add", ["y", "nothing"], ["other"]),
    ]
    assert_agrees(model_of(nodes, {"w": W, "zero": np.float32(0)}))


def test_all_refused_nodes_are_named_in_order() -> None:
    nodes = [
        node("LayerNormalization", ["x", "g"], ["l1"], name="norm1"),
        node("Relu", ["l1"], ["r"]),
        node("LayerNormalization", ["r", "g"], ["l2"], name="norm2"),
        node("Sin", ["l2"], ["s"]),
        node("Erfc", ["s"], ["e"], name="unknown"),
        node("LSTM", ["e", "g", "g"], ["t"], name="recurrent", hidden_size=3),
        node("MatMul", ["t", "w"], ["y"]),
    ]
    model = model_of(nodes, {"g": float32(3), "w": W})
    assert refused(model) == ["norm1", "norm2", "unknown", "recurrent"]
    with pytest.raises(ModelRefused, match=r"norm1 \(LayerNormalization, opset 17\): .*\n  Fix: "):
        import_network(model)


def test_refused_nodes_beside_the_output_do_not_matter() -> None:
    nodes = [
        node("MatMul", ["x", "w"], ["y"]),
        node("LayerNormalization", ["x", "g"], ["normal"]),
        node("RandomNormalLike", ["x"], ["noise"]),
    ]
    model = model_of(nodes, {"w": W, "g": float32(3)}, outputs=["y", "normal", "noise"])
    assert import_network(model).layout.output.name == "y"
    assert refused(model, output="noise") == ["noise"]


def test_random_weights_are_refused_though_they_are_constant() -> None:
    nodes = [node("RandomNormal", [], ["r"], name="noise", shape=[3, 1]), node("MatMul", ["x", "r"], ["y"])]
    assert refused(model_of(nodes, {})) == ["noise"]


@pytest.mark.parametrize("batch", [1, 2, 64, 2048, 100_000, 2**40])
def test_static_batches_cost_as_one_point(batch: int) -> None:
    nodes = [node("MatMul", ["x", "W"], ["p"]), node("Relu", ["p"], ["h"]), node("MatMul", ["h", "V"], ["y"])]
    model = model_of(nodes, {"W": float32(3, 64), "V": float32(64, 1)}, inputs={"x": (batch, 3)})
    imported = import_network(model)
    assert imported.layout.batch == batch
    assert len(imported.network.units) == 64


def test_static_batch_too_large_to_run_as_it_is() -> None:
    nodes = [node("Reshape", ["x", "s"], ["r"]), node("MatMul", ["r", "w"], ["y"])]
    model = model_of(nodes, {"s": int64(100_000, 3), "w": W}, inputs={"x": (100_000, 3)})
    with pytest.raises(ModelRefused, match="dynamic number of points"):
        import_network(model)


@pytest.mark.parametrize(
    "nodes",
    [
        [node("Expand", ["c", "big"], ["b"], name="bomb")],
        [node("Tile", ["c", "big"], ["b"], name="bomb")],
        [node("ConstantOfShape", ["big"], ["b"], name="bomb")],
        [node("Range", ["zero", "many", "one"], ["b"], name="bomb")],
        [node("Transpose", ["long"], ["l"]), node("Add", ["long", "l"], ["b"], name="bomb")],
        [node("OneHot", ["big", "many", "pair"], ["b"], name="bomb")],
        [node("Pad", ["c", "pads"], ["b"], name="bomb")],
    ],
    ids=lambda nodes: nodes[-1].op_type,
)
def test_small_files_cannot_ask_for_huge_tensors(nodes: list[onnx.NodeProto]) -> None:
    constants = {
        "c": float32(1, 3),
        "big": int64(2**40, 3),
        "zero": np.int64(0),
        "one": np.int64(1),
        "many": np.int64(2**40),
        "long": float32(1, 2**17),
        "pair": float32(2),
        "pads": int64(0, 0, 2**40, 0),
        "w": W,
    }
    rest = [node("ReduceSum", ["b"], ["total"], keepdims=0), node("Cast", ["total"], ["real"], to=1)]
    last = [node("Add", ["x", "real"], ["h"]), node("MatMul", ["h", "w"], ["y"])]
    model = model_of([*nodes, *rest, *last], constants)
    assert refused(model) == ["bomb"]


def test_endless_loop_is_refused() -> None:
    body = onnx.helper.make_graph(
        [node("Identity", ["in"], ["go"]), node("Relu", ["state"], ["next"])],
        "body",
        [
            onnx.helper.make_tensor_value_info(name, kind, shape)
            for name, kind, shape in (
                ("i", TensorProto.INT64, []),
                ("in", TensorProto.BOOL, []),
                ("state", TensorProto.FLOAT, ["N", 3]),
            )
        ],
        [
            onnx.helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            onnx.helper.make_tensor_value_info("next", TensorProto.FLOAT, None),
        ],
    )
    nodes = [node("Loop", ["", "true", "x"], ["h"], name="loop", body=body), node("MatMul", ["h", "w"], ["y"])]
    assert refused(model_of(nodes, {"true": np.asarray(True), "w": W})) == ["loop"]


def test_problems_inside_a_loop_are_named() -> None:
    body = onnx.helper.make_graph(
        [node("Identity", ["in"], ["go"]), node("LayerNormalization", ["state", "g"], ["next"], name="inner")],
        "body",
        [
            onnx.helper.make_tensor_value_info(name, kind, None)
            for name, kind in (("i", TensorProto.INT64), ("in", TensorProto.BOOL), ("state", TensorProto.FLOAT))
        ],
        [
            onnx.helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            onnx.helper.make_empty_tensor_value_info("next"),
        ],
    )
    nodes = [node("Loop", ["n", "", "x"], ["h"], name="loop", body=body), node("MatMul", ["h", "w"], ["y"])]
    assert refused(model_of(nodes, {"n": np.int64(2), "g": float32(3), "w": W})) == ["inner"]


@pytest.mark.parametrize(("opset", "op", "reads"), [(6, "Add", ["h", "h"]), (6, "PRelu", ["h", "slope"])])
def test_definitions_older_than_opset_7_are_refused_where_they_differ(opset: int, op: str, reads: list[str]) -> None:
    nodes = [node("MatMul", ["x", "W"], ["h"]), node(op, reads, ["o"], name="old"), node("MatMul", ["o", "v"], ["y"])]
    constants = {"W": float32(3, 4), "slope": float32(4), "v": float32(4, 1)}
    assert refused(model_of(nodes, constants, opset=opset)) == ["old"]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_refused(bad: float) -> None:
    weights = W.copy()
    weights[1] = bad
    assert refused(model_of([node("MatMul", ["x", "w"], ["y"], name="layer")], {"w": weights})) == ["layer"]


def test_shapes_that_do_not_fit_are_refused_at_their_node() -> None:
    nodes = [node("MatMul", ["x", "w"], ["h"]), node("Gemm", ["h", "v"], ["y"], name="layer")]
    assert refused(model_of(nodes, {"w": float32(3, 16), "v": float32(12, 1)})) == ["layer"]
