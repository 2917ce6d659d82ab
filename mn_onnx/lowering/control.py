"""Control flow with constant conditions, and sequences of tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx

from mn_onnx.lowering.context import Context, GraphValue
from mn_onnx.lowering.node import Node, OpaqueInput, UnsupportedNode
from mn_onnx.lowering.reduction import normal_axis
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Opaque, Tensor, concatenate, part, rearrange

INT64 = np.dtype(np.int64)


def conditional(context: Context, node: Node) -> tuple[GraphValue, ...]:
    """If with a constant condition: the branch that is taken."""
    taken = bool(np.ravel(node.constant(0, "condition"))[0])
    return tuple(context.run_graph(node.attribute("then_branch" if taken else "else_branch"), {}))


def loop(context: Context, node: Node) -> tuple[GraphValue, ...]:
    """Loop with constant trip count and condition, unrolled."""
    body: onnx.GraphProto = node.attribute("body")
    trips = int(np.ravel(node.constant(0, "trip count"))[0]) if node.has(0) else None
    proceed = bool(np.ravel(node.constant(1, "condition"))[0]) if node.has(1) else True
    state = [_given(value) for value in node.inputs[2:]]
    collected: list[list[GraphValue]] = [[] for _ in range(len(body.output) - 1 - len(state))]
    iteration = 0
    while proceed and (trips is None or iteration < trips):
        names = [value.name for value in body.input]
        counter = Constant(np.asarray(iteration, np.int64), INT64)
        condition = Constant(np.asarray(True), np.dtype(bool))
        outputs = context.run_graph(body, dict(zip(names, [counter, condition, *state], strict=True)))
        if isinstance(outputs[0], Opaque):
            raise OpaqueInput(outputs[0].problems)
        if not isinstance(outputs[0], Constant):
            raise UnsupportedNode("whether it goes on depends on the points", "export with a constant trip count")
        proceed = bool(np.ravel(outputs[0].array)[0])
        state = outputs[1 : 1 + len(state)]
        for values, value in zip(collected, outputs[1 + len(state) :], strict=True):
            values.append(value)
        iteration += 1
    return (*state, *(_stacked(values, 0) for values in collected))


def scan(context: Context, node: Node) -> tuple[GraphValue, ...]:
    """Scan over axes of fixed length, unrolled (from opset 9 on, without sequence lengths)."""
    body: onnx.GraphProto = node.attribute("body")
    n_scan = int(node.attribute("num_scan_inputs"))
    n_state = len(node.inputs) - n_scan
    state = [_given(value) for value in node.inputs[:n_state]]
    sequences = [node.tensor(index) for index in range(n_state, len(node.inputs))]
    n_collected = len(body.output) - n_state
    in_axes = node.attribute("scan_input_axes") or [0] * n_scan
    in_backward = node.attribute("scan_input_directions") or [0] * n_scan
    out_axes = node.attribute("scan_output_axes") or [0] * n_collected
    out_backward = node.attribute("scan_output_directions") or [0] * n_collected
    axes = [normal_axis(axis, len(x.shape)) for axis, x in zip(in_axes, sequences, strict=True)]
    length = sequences[0].shape[axes[0]]
    collected: list[list[GraphValue]] = [[] for _ in range(n_collected)]
    for i in range(length):
        steps = [
            _slice_at(x, axis, length - 1 - i if back else i)
            for x, axis, back in zip(sequences, axes, in_backward, strict=True)
        ]
        names = [value.name for value in body.input]
        outputs = context.run_graph(body, dict(zip(names, [*state, *steps], strict=True)))
        state = outputs[:n_state]
        for values, value in zip(collected, outputs[n_state:], strict=True):
            values.append(value)
    joined = [
        _stacked(values[::-1] if back else values, axis)
        for values, axis, back in zip(collected, out_axes, out_backward, strict=True)
    ]
    return (*state, *joined)


def _slice_at(x: Constant | Tensor, axis: int, position: int) -> Constant | Tensor:
    return rearrange(x, lambda array: np.take(array, position, axis))


def _given(value: Any) -> GraphValue:
    if value is None:
        raise UnsupportedNode("an initial value is missing")
    result: GraphValue = value
    return result


def _stacked(values: list[GraphValue], axis: int) -> GraphValue:
    problems: frozenset[int] = frozenset().union(*(v.problems for v in values if isinstance(v, Opaque)))
    if problems:
        return Opaque(problems)
    tensors = [value for value in values if isinstance(value, (Constant, Tensor))]
    if not tensors:
        raise UnsupportedNode("it runs zero times, so that the shape of its output is unknown")
    at = normal_axis(axis, len(tensors[0].shape) + 1)
    return concatenate([rearrange(value, lambda array: np.expand_dims(array, at)) for value in tensors], at)


def _sequence(node: Node) -> list[GraphValue]:
    value = node.inputs[0]
    if isinstance(value, Opaque):
        raise OpaqueInput(value.problems)
    if not isinstance(value, list):
        raise UnsupportedNode("its first input is not a sequence")
    return value


def _position(node: Node, index: int, size: int) -> int:
    position = int(np.ravel(node.constant(index, "position"))[0])
    if not -size <= position <= size:
        raise UnsupportedNode(f"position {position} lies outside a sequence of {size}")
    return position + size if position < 0 else position


def sequence_construct(_context: Context, node: Node) -> tuple[list[GraphValue]]:
    """A sequence of the inputs."""
    return (list(map(_given, node.inputs)),)


def sequence_insert(_context: Context, node: Node) -> tuple[list[GraphValue]]:
    """A sequence with one more tensor, at the end by default."""
    items = list(_sequence(node))
    items.insert(_position(node, 2, len(items)) if node.has(2) else len(items), node.tensor(1))
    return (items,)


def sequence_erase(_context: Context, node: Node) -> tuple[list[GraphValue]]:
    """A sequence without one tensor, the last by default."""
    items = list(_sequence(node))
    del items[_position(node, 1, len(items)) if node.has(1) else -1]
    return (items,)


def sequence_at(_context: Context, node: Node) -> GraphValue:
    """The tensor at a position."""
    items = _sequence(node)
    return items[_position(node, 1, len(items))]


def sequence_length(_context: Context, node: Node) -> Constant:
    """How many tensors there are."""
    return Constant(np.asarray(len(_sequence(node)), np.int64), INT64)


def split_to_sequence(_context: Context, node: Node) -> tuple[list[GraphValue]]:
    """Parts of given sizes, or slices of one element, as a sequence."""
    x = node.tensor(0)
    axis = normal_axis(int(node.attribute("axis", 0)), len(x.shape))
    sizes, single = [1] * x.shape[axis], not node.has(1)
    if node.has(1):
        given = node.constant(1, "list of sizes")
        sizes = given.tolist() if given.ndim else [int(given)] * (x.shape[axis] // int(given))
        if sum(sizes) < x.shape[axis]:
            sizes.append(x.shape[axis] - sum(sizes))
    parts: list[GraphValue] = []
    for end, size in zip(np.cumsum(sizes).tolist(), sizes, strict=True):
        piece = part(x, axis, end - size, size)
        if single and not node.attribute("keepdims", 1):
            piece = rearrange(piece, lambda array: np.squeeze(array, axis))
        parts.append(piece)
    return (parts,)


def concat_from_sequence(_context: Context, node: Node) -> GraphValue:
    """The tensors of a sequence, joined or stacked along an axis."""
    items, axis = _sequence(node), int(node.attribute("axis"))
    if node.attribute("new_axis", 0):
        return _stacked(items, axis)
    problems: frozenset[int] = frozenset().union(*(v.problems for v in items if isinstance(v, Opaque)))
    if problems:
        return Opaque(problems)
    tensors = [value for value in items if isinstance(value, (Constant, Tensor))]
    return concatenate(tensors, normal_axis(axis, len(tensors[0].shape)))


LOWERINGS: Table = {
    "If": same(conditional, on_constants=True),
    "Loop": same(loop, on_constants=True),
    "Scan": same(scan, 9, on_constants=True),
    "SequenceConstruct": same(sequence_construct, 11, on_constants=True),
    "SequenceEmpty": same(lambda _context, _node: ([],), 11, on_constants=True),
    "SequenceInsert": same(sequence_insert, 11, on_constants=True),
    "SequenceErase": same(sequence_erase, 11, on_constants=True),
    "SequenceAt": same(sequence_at, 11, on_constants=True),
    "SequenceLength": same(sequence_length, 11, on_constants=True),
    "SplitToSequence": same(split_to_sequence, 11, on_constants=True),
    "ConcatFromSequence": same(concat_from_sequence, 11, on_constants=True),
}
