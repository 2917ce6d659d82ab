"""Folding of nodes whose inputs are all constant, by onnx's own reference evaluator."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import onnx.defs
import onnx.helper
import onnx.reference

from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.symbolic import Constant, check_size, is_float

_FAILURES = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)


def fold(node: Node) -> tuple[Constant, ...]:
    """The outputs of a node with constant inputs, real numbers in float64.

    Raises `UnsupportedNode` if the evaluator does not know the operator or fails on it.
    """
    given = {name: value for name, value in zip(node.proto.input, node.inputs, strict=False) if name}
    arrays = {name: value.array for name, value in given.items() if isinstance(value, Constant)}
    shapes = [array.shape for array in arrays.values()]
    for shape in (*shapes, _joint_shape(shapes)):
        check_size(shape)
    names = [name for name in node.proto.output if name]
    try:
        evaluator = onnx.reference.ReferenceEvaluator(_model(node, list(arrays), names))
        results = evaluator.run(None, arrays)
    except (ArithmeticError, AttributeError, AssertionError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise UnsupportedNode(
            f"its constant inputs cannot be evaluated: {error}", "fold constants at export"
        ) from error
    real = next((v.dtype for v in given.values() if isinstance(v, Constant) and is_float(v.dtype)), None)
    by_name = dict(zip(names, (_constant(result, real) for result in results), strict=True))
    return tuple(by_name.get(name, Constant(np.zeros(0), np.dtype(np.float32))) for name in node.proto.output)


def _joint_shape(shapes: list[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape to which an elementwise operator would broadcast its inputs; empty if it cannot."""
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        return ()


def _model(node: Node, inputs: list[str], outputs: list[str]) -> onnx.ModelProto:
    anything = onnx.TypeProto()
    graph = onnx.helper.make_graph(
        [node.proto],
        "fold",
        [onnx.helper.make_value_info(name, anything) for name in inputs],
        [onnx.helper.make_value_info(name, anything) for name in outputs],
    )
    # A model can be newer than the installed onnx; definitions of known operators do not change then.
    newest = onnx.defs.onnx_opset_version()
    version = min(node.version, newest) if node.domain == "" else node.version
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid(node.domain, version)])


def _constant(result: Any, real: np.dtype | None) -> Constant:
    if not isinstance(result, (np.ndarray, np.generic)):
        raise UnsupportedNode(f"it gives a {type(result).__name__}, not a tensor")
    array = np.asarray(result)
    return Constant.of(array, real if real is not None and is_float(array.dtype) else array.dtype)
