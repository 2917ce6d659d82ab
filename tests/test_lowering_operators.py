"""Every lowered operator against onnxruntime, in a small network, for versions that define it differently."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from onnx_models import assert_agrees, float32, int64, model_of, node, run

from mn_onnx.lowering import LOWERINGS
from mn_onnx.operators import operator_table

WIDTH = 6


@dataclass(frozen=True)
class Case:
    """An operator on features [N, 6], first brought into ``shape`` (behind the batch), and further constant inputs."""

    op: str
    opset: int
    attributes: dict[str, Any] = field(default_factory=dict)
    extra: tuple[Any, ...] = ()
    shape: tuple[int, ...] = (WIDTH,)
    domain: str = ""
    n_outputs: int = 1
    data_last: bool = False

    def __str__(self) -> str:
        shown = ",".join(f"{key}={value}" for key, value in self.attributes.items() if np.size(value) < 5)
        return f"{self.op}-{self.opset}-{'x'.join(map(str, self.shape))}-{len(self.extra)}-{shown}"

    def nodes_and_constants(self) -> tuple[list[onnx.NodeProto], dict[str, np.ndarray]]:
        """Features, the operator, and its first output flattened to ``flat`` [N, features]."""
        constants = {"W": float32(3, WIDTH), "B": float32(WIDTH, seed=1)}
        names = []
        for i, value in enumerate(self.extra):
            names.append("" if value is None else f"c{i}")
            if value is not None:
                constants[f"c{i}"] = np.asarray(value)
        inputs = [*names, "data"] if self.data_last else ["data", *names]
        shape = numpy_helper.from_array(int64(-1, *self.shape))
        nodes = [
            node("MatMul", ["x", "W"], ["product"]),
            node("Add", ["product", "B"], ["features"]),
            node("Constant", [], ["shape"], value=shape),
            node("Reshape", ["features", "shape"], ["data"]),
            node(
                self.op,
                inputs,
                ["out", *(f"out{i}" for i in range(1, self.n_outputs))],
                domain=self.domain,
                **self.attributes,
            ),
            node("Flatten", ["out"], ["flat"], axis=1),
        ]
        return nodes, constants

    def model(self) -> onnx.ModelProto:
        """The operator's outputs in a linear combination with different weights."""
        nodes, constants = self.nodes_and_constants()
        domains = [self.domain] if self.domain else []
        features = model_of(nodes, constants, outputs=["flat"], opset=self.opset, domains=domains)
        width = run(features, {"x": np.zeros((2, 3), np.float32)})["flat"].shape[1]
        constants["V"] = np.cos(np.arange(1, width + 1), dtype=np.float32)[:, None]
        nodes.append(node("MatMul", ["flat", "V"], ["y"]))
        return model_of(nodes, constants, opset=self.opset, domains=domains)


def plain(opset: int, *operators: str) -> list[Case]:
    return [Case(op, opset) for op in operators]


ROW, ONE, SCALAR = float32(WIDTH, seed=2), float32(1, 1, seed=3), np.float32(0.7)
POSITIVE = np.abs(ROW) + 0.1
STATISTICS = (ROW, ROW[::-1].copy(), 0.3 * ROW, POSITIVE)

CASES = [
    # Functions of one number
    *plain(13, "Relu", "LeakyRelu", "Abs", "HardSigmoid", "Elu", "Selu", "Softplus", "Softsign", "Sigmoid", "Tanh"),
    *plain(13, "Exp", "Sin", "Cos", "Neg", "Identity", "Erf", "Sinh", "Cosh", "Asinh", "Atan"),
    *plain(18, "Mish", "HardSwish"),
    Case("ThresholdedRelu", 10, {"alpha": 0.0}),
    Case("LeakyRelu", 7, {"alpha": 0.2}),
    Case("Elu", 9, {"alpha": 0.5}),
    Case("Selu", 9, {"alpha": 1.5, "gamma": 1.1}),
    Case("Celu", 12, {"alpha": 0.7}),
    Case("HardSigmoid", 9, {"alpha": 0.3, "beta": 0.4}),
    Case("Shrink", 9, {"lambd": 0.3, "bias": 0.3}),
    Case("Gelu", 20),
    Case("Gelu", 20, {"approximate": "tanh"}),
    Case("PRelu", 9, {}, (ROW,)),
    Case("PRelu", 16, {}, (float32(1),)),
    Case("Clip", 7, {"min": -0.3, "max": 0.5}),
    Case("Clip", 10, {"max": 0.5}),
    Case("Clip", 11, {}, (np.float32(-0.2), np.float32(0.4))),
    Case("Clip", 13, {}, (None, np.float32(0.4))),
    Case("Clip", 13, {}, (np.float32(0.1),)),
    # Arithmetic
    *(Case(op, 13, {}, (ROW,)) for op in ("Add", "Sub", "Mul", "Div", "Max", "Min")),
    *(Case(op, 8, {}, (ONE,)) for op in ("Add", "Sub", "Mul", "Div", "Max", "Min", "Sum", "Mean")),
    *(Case(op, 14, {}, (ROW,), data_last=True) for op in ("Add", "Sub", "Mul", "Max", "Min")),
    *(Case(op, 13, {}, (ROW, ONE)) for op in ("Sum", "Mean", "Max", "Min")),
    Case("Pow", 13, {}, (np.float32(1),)),
    Case("Pow", 13, {}, (np.float32(2),)),
    Case("Pow", 13, {}, (np.float32(3),)),
    Case("Pow", 13, {}, (np.float32(2),), data_last=True),
    # Reductions
    *(
        Case(op, opset, {"axes": [axis], "keepdims": keep}, shape=(2, 3))
        for op in ("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin", "ReduceL1")
        for opset, axis, keep in ((11, -1, 1), (9, 1, 0))
    ),
    *(Case(op, 18, {}, (int64(1, 2),), (2, 3)) for op in ("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin")),
    *(Case(op, 13, {"axes": [1]}) for op in ("ReduceL2", "ReduceSumSquare", "ReduceLogSumExp")),
    Case("ReduceSum", 13, {"noop_with_empty_axes": 1}),
    Case("ReduceSum", 13, {"keepdims": 0}, (int64(-1),), (2, 3)),
    Case("ReduceSum", 13, {"noop_with_empty_axes": 1}, (np.zeros(0, np.int64),), (2, 3)),
    Case("ReduceMean", 18, {"noop_with_empty_axes": 1}, (), (2, 3)),
    Case("ReduceMax", 18, {"keepdims": 0}, (int64(-1, -2),), (2, 3)),
    Case("ReduceL1", 18, {}, (int64(-1),), (2, 3)),
    Case("ReduceLogSumExp", 18, {"keepdims": 0}, (int64(1),)),
    Case("CumSum", 14, {"reverse": 1}, (np.int32(-1),), (2, 3)),
    Case("MaxPool", 12, {"kernel_shape": [3], "auto_pad": "SAME_LOWER"}, (), (2, 3)),
    Case("AveragePool", 19, {"kernel_shape": [2], "dilations": [2]}, (), (2, 3)),
    Case("TopK", 11, {"axis": -1, "largest": 0}, (int64(3),), (2, 3), n_outputs=2),
    Case("TopK", 11, {}, (int64(1),), (2, 3), n_outputs=2),
    Case("TopK", 10, {"axis": 1}, (int64(2),), (2, 3), n_outputs=2),
    Case("CumSum", 11, {"exclusive": 1, "reverse": 1}, (np.int64(1),)),
    Case("CumSum", 14, {}, (np.int64(-1),)),
    Case("Softmax", 13, {"axis": -1}, shape=(3, 2)),
    Case("Softmax", 11, {"axis": 2}, shape=(3, 2)),
    Case("LogSoftmax", 13, {"axis": 1}, shape=(2, 3)),
    *(Case(op, 12, {"kernel_shape": [2]}, shape=(2, 3)) for op in ("MaxPool", "AveragePool")),
    *(
        Case(op, 12, {"kernel_shape": [2], "strides": [2], "pads": [1, 0]}, shape=(2, 3))
        for op in ("MaxPool", "AveragePool")
    ),
    *(
        Case(op, 12, {"kernel_shape": [2], "strides": [2], "ceil_mode": 1}, shape=(2, 3))
        for op in ("MaxPool", "AveragePool")
    ),
    Case("AveragePool", 12, {"kernel_shape": [2], "pads": [1, 1], "count_include_pad": 1}, shape=(2, 3)),
    Case(
        "AveragePool", 19, {"kernel_shape": [2], "strides": [2], "ceil_mode": 1, "count_include_pad": 1}, shape=(2, 3)
    ),
    Case("GlobalMaxPool", 11, shape=(2, 3)),
    Case("GlobalAveragePool", 11, shape=(2, 3)),
    # Products
    Case("Gemm", 13, {"alpha": 0.5, "beta": 2.0, "transB": 1}, (float32(4, WIDTH), float32(4))),
    Case("Gemm", 13, {"beta": 2.0}, (float32(WIDTH, 4), ONE)),
    Case("Gemm", 11, {}, (float32(WIDTH, 4),)),
    Case("Gemm", 7, {"beta": 0.0}, (float32(WIDTH, 4), float32(4))),
    Case("Gemm", 13, {"alpha": 0.0}, (float32(WIDTH, 4), float32(4))),
    Case("Gemm", 13, {"beta": 0.5}, (float32(WIDTH, 4), np.float32(2.0))),
    Case("Einsum", 12, {"equation": " n a b , b c -> n a c "}, (float32(3, 4),), (2, 3)),
    Case("Einsum", 12, {"equation": "nab,nab->n"}, (float32(1, 2, 3),), (2, 3)),
    Case("Einsum", 12, {"equation": "nab,b,bc->nac"}, (float32(3), float32(3, 4)), (2, 3)),
    Case("MatMul", 13, {}, (float32(3, 4),), (2, 3)),
    Case("MatMul", 9, {}, (float32(1, 3, 4),), (2, 3)),
    Case("MatMul", 13, {}, (float32(5, 2),), (2, 3), data_last=True),
    Case("Einsum", 12, {"equation": "nab,bc->nac"}, (float32(3, 4),), (2, 3)),
    Case("Einsum", 12, {"equation": "...b,bc->...c"}, (float32(3, 4),), (2, 3)),
    Case("Einsum", 12, {"equation": "nab,abc->nbc"}, (float32(2, 3, 4),), (2, 3)),
    Case("Einsum", 13, {"equation": "nab->nba"}, shape=(2, 3)),
    Case("Einsum", 13, {"equation": "nab->nb"}, shape=(2, 3)),
    Case("Einsum", 12, {"equation": "ca,nab->ncb"}, (float32(4, 2),), (2, 3), data_last=True),
    Case("Conv", 11, {"kernel_shape": [1]}, (float32(4, 2, 1), float32(4)), (2, 3)),
    Case("Conv", 11, {"kernel_shape": [3], "pads": [1, 1]}, (float32(4, 2, 3), float32(4)), (2, 3)),
    Case("Conv", 11, {"strides": [2], "group": 2, "auto_pad": "SAME_UPPER"}, (float32(4, 1, 2),), (2, 3)),
    Case("Conv", 11, {"dilations": [2], "group": 2, "auto_pad": "VALID"}, (float32(4, 1, 2),), (2, 3)),
    Case("Conv", 11, {}, (float32(2, 1, 1, 2),), (1, 2, 3)),
    Case("ConvTranspose", 11, {"group": 2}, (float32(2, 3, 1), float32(6)), (2, 3)),
    Case("BatchNormalization", 8, {}, STATISTICS),
    Case("BatchNormalization", 15, {"epsilon": 0.1}, tuple(part[:2] for part in STATISTICS), (2, 3)),
    # Rearrangement
    Case("Transpose", 13, {"perm": [0, 2, 1]}, shape=(2, 3)),
    Case("Flatten", 13, {"axis": 1}, shape=(2, 3)),
    Case("Squeeze", 11, {"axes": [1]}, shape=(1, WIDTH)),
    Case("Squeeze", 13, {}, (int64(-1),), (WIDTH, 1)),
    Case("Unsqueeze", 11, {"axes": [1]}),
    Case("Unsqueeze", 13, {}, (int64(-1),)),
    Case("Tile", 13, {}, (int64(1, 2),)),
    Case("Slice", 9, {"starts": [1], "ends": [-1], "axes": [1]}),
    Case("Slice", 13, {}, (int64(-1), int64(-100), int64(1), int64(-2))),
    Case("Slice", 11, {}, (int64(1), int64(2**63 - 1), int64(-1))),
    Case("Split", 13, {"axis": 1}, (int64(2, 4),), n_outputs=2),
    Case("Split", 11, {"axis": -1}, n_outputs=3),
    Case("Split", 18, {"axis": -1, "num_outputs": 3}, n_outputs=3),
    Case("Pad", 10, {"pads": [0, 1, 0, 2], "value": 0.3}),
    Case("Pad", 11, {}, (int64(0, 1, 0, 2), np.float32(0.5))),
    Case("Pad", 13, {"mode": "reflect"}, (int64(0, 1, 0, 2),)),
    Case("Pad", 13, {"mode": "edge"}, (int64(0, 1, 0, -2),)),
    Case("Slice", 13, {}, (int64(4), int64(-10), int64(-1), int64(-2))),
    Case("Slice", 10, {}, tuple(np.array([value], np.int32) for value in (4, 0, 1, -3))),
    Case("Slice", 11, {}, (int64(0, 1), int64(2, 3), int64(-2, -1)), (2, 3)),
    Case("Split", 18, {"axis": -1, "num_outputs": 2}, (), (2, 3), n_outputs=2),
    Case("Split", 13, {"axis": -1}, (int64(0, 6),), n_outputs=2),
    Case("Pad", 18, {}, (int64(1, 2), np.float32(0.3), int64(-1))),
    Case("Pad", 19, {"mode": "wrap"}, (int64(0, 2, 0, 1),)),
    Case("Pad", 18, {"mode": "constant"}, (int64(0, -1, 0, -2),)),
    Case("Pad", 18, {"mode": "reflect"}, (int64(0, 1, 1, 0, 0, 2),), (2, 3)),
    Case("Reshape", 14, {"allowzero": 1}, (int64(-1, 2, 3),)),
    Case("Reshape", 13, {}, (int64(0, -1, 2),)),
    Case("Flatten", 11, {"axis": -2}, shape=(2, 3)),
    Case("Unsqueeze", 11, {"axes": [-1, 1]}),
    Case("Gather", 13, {"axis": -2}, (int64(1, 0, -1),), (2, 3)),
    Case("Expand", 8, {}, (int64(1, 2, 1),), (1, 6)),
    Case("Trilu", 14, {}, (np.int64(-1),), (2, 3)),
    Case("Trilu", 14, {"upper": 0}, shape=(2, 3)),
    Case("Trilu", 14, {}, (np.int64(1),), (2, 3)),
    Case("DepthToSpace", 13, {"blocksize": 1, "mode": "CRD"}, shape=(6, 1, 1)),
    Case("SpaceToDepth", 13, {"blocksize": 1}, shape=(1, 2, 3)),
    Case("Gather", 13, {"axis": 1}, (int64(-1, 0, 3),)),
    Case("Gather", 11, {"axis": -1}, (np.int64(2),), (2, 3)),
    Case("Compress", 11, {"axis": 1}, (np.array([1, 0, 1, 1, 0, 0], bool),)),
    # Outside the standard domain
    *(Case(op, 13, domain="com.microsoft") for op in ("QuickGelu", "Gelu")),
    *(Case(op, 13, {}, (ROW,), domain="com.microsoft") for op in ("BiasGelu", "FastGelu")),
    Case("FusedMatMul", 13, {"alpha": 0.3, "transB": 1}, (float32(4, WIDTH),), domain="com.microsoft"),
    *(
        Case(
            "FusedGemm", 13, {"activation": name, **parameters}, (float32(WIDTH, 4), float32(4)), domain="com.microsoft"
        )
        for name, parameters in (("Relu", {}), ("LeakyRelu", {"activation_alpha": 0.2}), ("Tanh", {}))
    ),
    Case(
        "FusedConv",
        11,
        {"kernel_shape": [1], "activation": "Relu"},
        (float32(4, 2, 1), float32(4)),
        (2, 3),
        "com.microsoft",
    ),
    Case("ExpandDims", 13, {}, (np.int32(-1),), domain="com.microsoft"),
    Case("Trilu", 13, {}, (np.int64(1),), (2, 3), "com.microsoft"),
    Case("Pad", 13, {}, (int64(0, 1, 0, 1), np.float32(0.2)), domain="com.microsoft"),
    Case("FusedMatMul", 13, {"transA": 1}, (float32(2, 4),), (2, 3), "com.microsoft"),
    Case("Scaler", 13, {"offset": [0.1] * 6, "scale": [0.5, 1.0, 2.0, 3.0, 4.0, 5.0]}, domain="ai.onnx.ml"),
    Case(
        "LinearRegressor",
        13,
        {"coefficients": [0.1, -0.2] * 6, "intercepts": [0.3, 0.4], "targets": 2},
        domain="ai.onnx.ml",
    ),
    Case("ArrayFeatureExtractor", 13, {}, (int64(3, 1),), domain="ai.onnx.ml"),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_operator_agrees_with_onnxruntime(case: Case) -> None:
    assert_agrees(case.model())


def test_most_operators_are_covered() -> None:
    """Operators of the table that no test touches would be untested promises."""
    elsewhere = {
        # test_lowering_logic.py
        "Less",
        "Greater",
        "LessOrEqual",
        "GreaterOrEqual",
        "Equal",
        "Where",
        "And",
        "Or",
        "Xor",
        "Not",
        "Sign",
        "IsNaN",
        "IsInf",
        "Floor",
        "Ceil",
        "Round",
        "Mod",
        "Cast",
        "CastLike",
        "Binarizer",
        # test_lowering_structure.py
        "If",
        "Loop",
        "Scan",
        "SequenceConstruct",
        "SequenceEmpty",
        "SequenceInsert",
        "SequenceErase",
        "SequenceAt",
        "SequenceLength",
        "SplitToSequence",
        "ConcatFromSequence",
        "Constant",
        "ConstantOfShape",
        "Shape",
        "Size",
        "Range",
        "Expand",
        "Concat",
        "Reshape",
        "Dropout",
        "DequantizeLinear",
        "Scatter",
        "ScatterElements",
        "ScatterND",
        "GatherND",
        "GatherElements",
        "OneHot",
        "ReverseSequence",
        # test_lowering_domains.py
        "Log",
        "Sqrt",
        "Reciprocal",
        "Tan",
        "Asin",
        "Acos",
        "Acosh",
        "Atanh",
        "Swish",
        "ReduceProd",
        "ReduceLogSum",
        "TransposeMatMul",
        # test_lowering_structure.py
        "MatMulNBits",
        "Imputer",
        "FeatureVectorizer",
    }
    covered = {case.op for case in CASES} | elsewhere
    assert {operator for _, operator in LOWERINGS} - covered == set()


def test_the_table_for_people_lists_every_operator_once() -> None:
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in operator_table().splitlines()[2:]]
    listed = {(domain, fidelity, name) for domain, fidelity, names in rows for name in names.split(", ")}
    assert len(listed) == sum(len(names.split(", ")) for _, _, names in rows) == len(LOWERINGS)
    assert {("ai.onnx", "exact", "Clip 6"), ("com.microsoft", "surrogate", "QuickGelu")} <= listed
    assert {name.partition(" ")[0] for _, _, name in listed} == {operator for _, operator in LOWERINGS}
