"""Folding of nodes whose inputs are all constant, by onnx's own reference evaluator, or by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import onnx.defs
import onnx.helper
import onnx.reference

from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.symbolic import Array, Constant, check_size, is_float

_MISREAD = {
    "BatchNormalization": 14,
    "Hardmax": 13,
    "LogSoftmax": 13,
    "Softmax": 13,
    "GlobalMaxPool": 1 << 30,
    "LRN": 1 << 30,
    "LpNormalization": 1 << 30,
}
"""Operators that the reference evaluator computes otherwise than they are defined before this version."""
_JUMPING = frozenset(
    {"Ceil", "Floor", "Round", "Mod", "Equal", "Less", "Greater", "LessOrEqual", "GreaterOrEqual"}
    | {"ArgMax", "ArgMin", "TopK", "Unique"}
)
"""Operators for which it matters that real numbers are rounded as in the graph."""


def fold(node: Node) -> tuple[Constant, ...]:
    """The outputs of a node with constant inputs, real numbers in float64.

    Raises `UnsupportedNode` if no evaluator knows the operator, or all fail on it.
    """
    given = {name: value for name, value in zip(node.proto.input, node.inputs, strict=False) if name}
    constants = {name: value for name, value in given.items() if isinstance(value, Constant)}
    shapes = [value.shape for value in constants.values()]
    for shape in (*shapes, _joint_shape(shapes)):
        check_size(shape)
    names = [name for name in node.proto.output if name]
    results = _evaluate(node, constants, names)
    real = next((value.dtype for value in constants.values() if is_float(value.dtype)), None)
    by_name = dict(zip(names, (_constant(result, real) for result in results), strict=True))
    return tuple(by_name.get(name, Constant(np.zeros(0), np.dtype(np.float32))) for name in node.proto.output)


def _evaluate(node: Node, constants: Mapping[str, Constant], names: list[str]) -> list[Any]:
    """By the reference evaluator where it is right, which keeps real numbers in float64; else by onnxruntime."""
    failure: Exception | None = None
    if node.domain != "com.microsoft" and node.version >= _MISREAD.get(node.op, 0):
        jumping = node.op in _JUMPING
        arrays = {name: value.declared if jumping else value.array for name, value in constants.items()}
        # The evaluator raises whatever its numpy code raises.
        try:
            return list(onnx.reference.ReferenceEvaluator(_model(node, {}, list(arrays), names)).run(None, arrays))
        except (
            ArithmeticError,
            AttributeError,
            AssertionError,
            LookupError,
            RuntimeError,
            TypeError,
            ValueError,
        ) as error:
            failure = error
    # Most models never get here, and onnxruntime takes long to load.
    from mn_onnx.checks.runtime import ORT_REFUSALS, open_session

    arrays = {name: value.declared for name, value in constants.items()}
    try:
        return list(open_session(_model(node, arrays, list(arrays), names), threads=1).run(names, arrays))
    except (*ORT_REFUSALS, KeyError, TypeError, ValueError) as error:
        failure = failure or error
    raise UnsupportedNode(
        f"its constant inputs cannot be evaluated: {failure}", "fold constants at export"
    ) from failure


def _joint_shape(shapes: list[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape to which an elementwise operator would broadcast its inputs; empty if it cannot."""
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        return ()


def _model(node: Node, typed: Mapping[str, Array], inputs: list[str], outputs: list[str]) -> onnx.ModelProto:
    """A model of this node alone; inputs have the types and shapes of the ``typed``, others none."""
    graph = onnx.helper.make_graph(
        [node.proto],
        "fold",
        [_value_info(name, typed.get(name)) for name in inputs],
        [_value_info(name, None) for name in outputs],
    )
    # A model can be newer than the installed onnx; definitions of known operators do not change then.
    newest = onnx.defs.onnx_opset_version()
    version = min(node.version, newest) if node.domain == "" else node.version
    opsets = [onnx.helper.make_opsetid(node.domain, version)]
    oldest = onnx.helper.find_min_ir_version_for(opsets, ignore_unknown=True)
    return onnx.helper.make_model(graph, opset_imports=opsets, ir_version=oldest)


def _value_info(name: str, array: Array | None) -> onnx.ValueInfoProto:
    if array is None:
        return onnx.helper.make_value_info(name, onnx.TypeProto())
    return onnx.helper.make_tensor_value_info(name, onnx.helper.np_dtype_to_tensor_dtype(array.dtype), array.shape)


def _constant(result: Any, real: np.dtype | None) -> Constant:
    if not isinstance(result, (np.ndarray, np.generic)):
        raise UnsupportedNode(f"it gives a {type(result).__name__}, not a tensor")
    array = np.asarray(result)
    return Constant.of(array, real if real is not None and is_float(array.dtype) else array.dtype)
