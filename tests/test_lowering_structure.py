"""Shape arithmetic, indexing, control flow, sequences and quantised weights, as exporters write them."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from onnx_models import assert_agrees, float32, int64, model_of, node

from mn_onnx.errors import ModelRefused
from mn_onnx.importer import import_network

W, V = float32(3, 6), float32(6, 1, seed=1)
BASE = {"W": W, "V": V}
LAYER = [node("MatMul", ["x", "W"], ["p"]), node("Relu", ["p"], ["h"])]
OUTPUT = [node("MatMul", ["z", "V"], ["y"])]


def graph(
    nodes: list[onnx.NodeProto], inputs: list[tuple[str, int, list[int | str]]], outputs: list[str]
) -> onnx.GraphProto:
    return helper.make_graph(
        nodes,
        "body",
        [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in inputs],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
    )


def test_expand_written_with_shapes_and_where() -> None:
    """The chain that PyTorch's TorchScript exporter writes for ``latent.expand(n, -1)``."""
    nodes = [
        node("Shape", ["x"], ["s"]),
        node("Gather", ["s", "zero"], ["n"], axis=0),
        node("Unsqueeze", ["n", "axes"], ["n1"]),
        node("Concat", ["n1", "minus"], ["target"], axis=0),
        node("Shape", ["target"], ["rank"]),
        node("ConstantOfShape", ["rank"], ["ones"], value=onnx.numpy_helper.from_array(int64(1))),
        node("Mul", ["ones", "minus"], ["negative"]),
        node("Equal", ["target", "negative"], ["keep"]),
        node("Where", ["keep", "ones", "target"], ["size"]),
        node("Expand", ["latent", "size"], ["codes"]),
        node("Concat", ["codes", "x"], ["joined"], axis=1),
        node("MatMul", ["joined", "W"], ["p"]),
        node("Relu", ["p"], ["z"]),
        *OUTPUT,
    ]
    constants = {
        "W": float32(7, 6),
        "V": V,
        "latent": float32(1, 4),
        "zero": np.int64(0),
        "axes": int64(0),
        "minus": int64(-1),
    }
    assert_agrees(model_of(nodes, constants))


def test_slice_assignment_by_scatter() -> None:
    """``h[:, 1] = 2 h[:, 0]`` with indices from Range over the dynamic batch, and GatherND to read it back."""
    nodes = [
        *LAYER,
        node("Shape", ["h"], ["s"]),
        node("Gather", ["s", "zero"], ["n"], axis=0),
        node("Range", ["zero", "n", "one"], ["rows"]),
        node("Unsqueeze", ["rows", "axes"], ["column"]),
        node("Mul", ["column", "zero"], ["zeros"]),
        node("Add", ["zeros", "one"], ["ones"]),
        node("Concat", ["column", "ones"], ["to"], axis=1),
        node("Concat", ["column", "zeros"], ["from"], axis=1),
        node("GatherND", ["h", "from"], ["read"]),
        node("Mul", ["read", "two"], ["update"]),
        node("ScatterND", ["h", "to", "update"], ["z"]),
        *OUTPUT,
    ]
    constants = BASE | {"zero": np.int64(0), "one": np.int64(1), "axes": int64(1), "two": np.float32(2)}
    assert_agrees(model_of(nodes, constants))


@pytest.mark.parametrize(
    ("op", "opset", "attributes"),
    [
        ("Scatter", 10, {}),
        ("ScatterElements", 13, {}),
        ("ScatterElements", 18, {"reduction": "add"}),
        ("ScatterElements", 18, {"reduction": "max"}),
    ],
)
def test_scatter_elements(op: str, opset: int, attributes: dict[str, str]) -> None:
    """Rows of one point, so that constant indices address its features."""
    nodes = [*LAYER, node(op, ["h", "i", "u"], ["z"], axis=1, **attributes), *OUTPUT]
    constants = BASE | {"i": np.array([[1, -3, 4]]), "u": float32(1, 3)}
    assert_agrees(model_of(nodes, constants, inputs={"x": (1, 3)}, opset=opset))


def test_scatter_joins_several_updates_of_one_place() -> None:
    nodes = [*LAYER, node("ScatterElements", ["h", "i", "u"], ["z"], axis=1, reduction="add"), *OUTPUT]
    constants = BASE | {"i": np.array([[2, 2, -4, 0]]), "u": float32(1, 4)}
    assert_agrees(model_of(nodes, constants, inputs={"x": (1, 3)}, opset=18))


def test_gather_elements_and_reverse_sequence() -> None:
    nodes = [
        *LAYER,
        node("GatherElements", ["h", "i"], ["g"], axis=1),
        node("Reshape", ["g", "shape"], ["r"]),
        node("ReverseSequence", ["r", "lengths"], ["b"], time_axis=0, batch_axis=1),
        node("Reshape", ["b", "back"], ["z"]),
        *OUTPUT,
    ]
    constants = BASE | {
        "i": np.array([[5, 0, 1, 1, 2, -1]]),
        "shape": int64(3, 2),
        "lengths": int64(3, 2),
        "back": int64(1, 6),
    }
    assert_agrees(model_of(nodes, constants, inputs={"x": (1, 3)}))


def test_one_hot_mask_of_constants() -> None:
    nodes = [*LAYER, node("OneHot", ["i", "depth", "pair"], ["mask"]), node("Mul", ["h", "mask"], ["z"]), *OUTPUT]
    constants = BASE | {"i": int64(-2), "depth": np.int64(6), "pair": float32(2)}
    assert_agrees(model_of(nodes, constants))


def test_reshape_keeps_and_infers_axes() -> None:
    nodes = [
        *LAYER,
        node("Reshape", ["h", "split"], ["r"]),
        node("Size", ["r"], ["size"]),
        node("Cast", ["size"], ["real"], to=TensorProto.FLOAT),
        node("Mul", ["real", "nothing"], ["offset"]),
        node("Add", ["r", "offset"], ["t"]),
        node("Reshape", ["t", "flat"], ["z"], allowzero=1),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, BASE | {"split": int64(0, -1, 2), "flat": int64(-1, 6), "nothing": np.float32(0)}))


def test_dropout_does_nothing_at_inference() -> None:
    nodes = [*LAYER, node("Dropout", ["h", "ratio", "training"], ["z", "mask"]), *OUTPUT]
    assert_agrees(model_of(nodes, BASE | {"ratio": np.float32(0.5), "training": np.asarray(False)}))
    with pytest.raises(ModelRefused, match="training mode"):
        import_network(model_of(nodes, BASE | {"ratio": np.float32(0.5), "training": np.asarray(True)}))


@pytest.mark.parametrize("condition", [True, False])
def test_if_with_constant_condition(condition: bool) -> None:
    then = graph([node("Relu", ["h"], ["t"])], [], ["t"])
    other = graph([node("Neg", ["h"], ["e"])], [], ["e"])
    nodes = [*LAYER, node("If", ["c"], ["z"], then_branch=then, else_branch=other), *OUTPUT]
    assert_agrees(model_of(nodes, BASE | {"c": np.asarray(condition)}))


def test_if_on_data_is_refused() -> None:
    branch = graph([node("Relu", ["h"], ["t"])], [], ["t"])
    nodes = [
        *LAYER,
        node("Greater", ["y0", "zero"], ["c"]),
        node("If", ["c"], ["z"], name="branching", then_branch=branch, else_branch=branch),
        *OUTPUT,
    ]
    nodes.insert(2, node("ReduceSum", ["h"], ["y0"], keepdims=0))
    with pytest.raises(ModelRefused, match="branching"):
        import_network(model_of(nodes, BASE | {"zero": np.float32(0)}, inputs={"x": (1, 3)}))


def test_loop_with_shared_and_indexed_weights() -> None:
    body = graph(
        [
            node("Gather", ["layers", "i"], ["w"]),
            node("MatMul", ["state", "w"], ["p1"]),
            node("Relu", ["p1"], ["next"]),
            node("ReduceMean", ["next"], ["mean"], axes=[1], keepdims=0),
            node("Less", ["i", "last"], ["go"]),
        ],
        [("i", TensorProto.INT64, []), ("in", TensorProto.BOOL, []), ("state", TensorProto.FLOAT, ["N", 6])],
        ["go", "next", "mean"],
    )
    body.output[0].type.tensor_type.elem_type = TensorProto.BOOL
    nodes = [
        *LAYER,
        node("Loop", ["trips", "true", "h"], ["state_out", "means"], body=body),
        node("Transpose", ["means"], ["columns"], perm=[1, 0]),
        node("Concat", ["state_out", "columns"], ["all"], axis=1),
        node("MatMul", ["all", "U"], ["y"]),
    ]
    constants = BASE | {
        "layers": float32(5, 6, 6),
        "trips": np.int64(5),
        "true": np.asarray(True),
        "last": np.int64(2),
        "U": float32(9, 1),
    }
    assert_agrees(model_of(nodes, constants, opset=13))


def test_scan_over_features() -> None:
    body = graph(
        [
            node("Add", ["sum_in", "item"], ["sum"]),
            node("Relu", ["sum"], ["sum_out"]),
            node("Identity", ["sum_out"], ["each"]),
        ],
        [("sum_in", TensorProto.FLOAT, ["N"]), ("item", TensorProto.FLOAT, ["N"])],
        ["sum_out", "each"],
    )
    nodes = [
        *LAYER,
        node("Gather", ["h", "zero"], ["start"], axis=1),
        node(
            "Scan",
            ["start", "h"],
            ["last", "z"],
            body=body,
            num_scan_inputs=1,
            scan_input_axes=[1],
            scan_input_directions=[1],
            scan_output_axes=[1],
        ),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, BASE | {"zero": np.int64(0)}))


def test_sequences() -> None:
    nodes = [
        *LAYER,
        node("SplitToSequence", ["h", "two"], ["parts"], axis=1),
        node("SequenceAt", ["parts", "zero"], ["a"]),
        node("SequenceInsert", ["parts", "a", "one"], ["more"]),
        node("SequenceErase", ["more", "zero"], ["fewer"]),
        node("SequenceLength", ["fewer"], ["n"]),
        node("SequenceConstruct", ["a", "a"], ["pair"]),
        node("ConcatFromSequence", ["fewer"], ["joined"], axis=1),
        node("ConcatFromSequence", ["pair"], ["stacked"], axis=1, new_axis=1),
        node("Flatten", ["stacked"], ["flat"]),
        node("Cast", ["n"], ["count"], to=TensorProto.FLOAT),
        node("Mul", ["joined", "count"], ["scaled"]),
        node("SequenceEmpty", [], ["none"]),
        node("SequenceInsert", ["none", "scaled"], ["some"]),
        node("SequenceInsert", ["some", "flat"], ["both"]),
        node("ConcatFromSequence", ["both"], ["all"], axis=1),
        node("MatMul", ["all", "U"], ["y"]),
    ]
    constants = {"W": W, "two": int64(2, 4), "zero": np.int64(0), "one": np.int64(1), "U": float32(10, 1)}
    assert_agrees(model_of(nodes, constants))


@pytest.mark.parametrize(
    ("scale", "zero", "attributes"),
    [
        (np.float32(0.02), np.int8(3), {}),
        (np.abs(float32(6)), np.arange(6, dtype=np.int8), {"axis": 1}),
        (np.abs(float32(3)), None, {"axis": 0}),
    ],
)
def test_quantised_weights_are_what_they_compute(
    scale: np.ndarray, zero: np.ndarray | None, attributes: dict[str, int]
) -> None:
    quantised = np.random.default_rng(0).integers(-128, 127, (3, 6)).astype(np.int8)
    constants = {"Q": quantised, "s": scale, "V": V} | ({} if zero is None else {"z0": zero})
    nodes = [
        node("DequantizeLinear", ["Q", "s", *([] if zero is None else ["z0"])], ["W"], **attributes),
        *LAYER,
        node("Identity", ["h"], ["z"]),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, constants), tolerance=1e-4)


def test_blocks_of_quantised_weights() -> None:
    constants = {
        "Q": np.random.default_rng(0).integers(-128, 127, (4, 6)).astype(np.int8),
        "s": np.abs(float32(2, 6)),
        "z0": np.ones((2, 6), np.int8),
        "V": V,
        "K": float32(3, 4),
    }
    nodes = [
        node("DequantizeLinear", ["Q", "s", "z0"], ["W"], axis=0, block_size=2),
        node("MatMul", ["x", "K"], ["k"]),
        node("MatMul", ["k", "W"], ["p"]),
        node("Relu", ["p"], ["z"]),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, constants, opset=21), tolerance=1e-4)


@pytest.mark.parametrize("bits", [4, 8])
@pytest.mark.parametrize("with_zero_points", [False, True])
def test_weights_packed_for_onnxruntime(bits: int, with_zero_points: bool) -> None:
    width, rows, block = 40, 6, 16
    generator = np.random.default_rng(0)
    packed = generator.integers(0, 256, (rows, 3, block * bits // 8)).astype(np.uint8)
    constants = {"W": float32(3, width), "B": packed, "s": 0.1 * float32(rows * 3), "V": V}
    reads = ["p", "B", "s"]
    if with_zero_points:
        constants["z0"] = generator.integers(0, 256, (rows, -(-3 * bits // 8))).astype(np.uint8)
        reads.append("z0")
    nodes = [
        LAYER[0],
        node("MatMulNBits", reads, ["z"], domain="com.microsoft", K=width, N=rows, bits=bits, block_size=block),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, constants, domains=["com.microsoft"]), tolerance=1e-4)


def test_features_of_scikit_learn_pipelines() -> None:
    nodes = [
        node(
            "Imputer", ["x"], ["i"], domain="ai.onnx.ml", imputed_value_floats=[0.0], replaced_value_float=float("nan")
        ),
        node("FeatureVectorizer", ["i", "i"], ["f"], domain="ai.onnx.ml", inputdimensions=[3, 3]),
        node("Relu", ["f"], ["z"]),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, {"V": V}, domains=["ai.onnx.ml"]))


def test_weight_norm_left_in_the_graph() -> None:
    nodes = [
        node("ReduceL2", ["direction"], ["norm"], axes=[0], keepdims=1),
        node("Div", ["direction", "norm"], ["unit"]),
        node("Mul", ["unit", "gain"], ["W"]),
        *LAYER,
        node("Identity", ["h"], ["z"]),
        *OUTPUT,
    ]
    assert_agrees(model_of(nodes, {"direction": W, "gain": np.abs(float32(1, 6)), "V": V}))


def test_a_latent_code_may_pass_any_foldable_operator() -> None:
    """Only what depends on the points must be piecewise linear: LayerNormalization of a bound code is a constant."""
    nodes = [
        node("LayerNormalization", ["code", "gain"], ["normal"]),
        node("Softmax", ["normal"], ["weights"]),
        node("Mul", ["p", "weights"], ["modulated"]),
        node("Relu", ["modulated"], ["z"]),
        *OUTPUT,
    ]
    nodes.insert(0, LAYER[0])
    model = model_of(nodes, BASE | {"gain": float32(6)}, inputs={"x": ("N", 3), "code": (1, 6)})
    assert_agrees(model, bind={"code": float32(6, seed=5)})
    with pytest.raises(ModelRefused, match="code"):
        import_network(model)
