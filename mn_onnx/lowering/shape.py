"""Lowering of operators that only rearrange elements, and of those that make constants."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.reduction import normal_axis
from mn_onnx.lowering.table import Lowering, Table, same
from mn_onnx.symbolic import Constant, Tensor, check_size, concatenate, lift, part, rearrange

Movable = Constant | Tensor

INT64 = np.dtype(np.int64)
_NUMBERS = {"value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}


def identity(_context: Context, node: Node) -> Movable:
    """Identity."""
    return node.tensor(0)


def dropout(_context: Context, node: Node) -> tuple[Movable, ...]:
    """Dropout does nothing at inference; from opset 12 on an input can ask for training."""
    x = node.tensor(0)
    training = node.optional(2, "training mode") if node.version >= 12 else None
    if training is not None and bool(np.ravel(training)[0]):
        ratio = node.optional(1, "ratio")
        if ratio is None or float(np.ravel(ratio)[0]) != 0.0:
            raise UnsupportedNode("in training mode it drops random elements", "call model.eval() before the export")
    mask = Constant(np.ones(x.shape, np.bool_), np.dtype(bool))
    return (x, mask)[: node.n_outputs]


def reshape(_context: Context, node: Node) -> Movable:
    """Reshape to a shape with at most one -1, where zero copies an axis unless ``allowzero`` is set."""
    x = node.tensor(0)
    target = node.integers(1, "shape", "shape") or []
    if not node.attribute("allowzero", 0):
        try:
            target = [x.shape[axis] if size == 0 else size for axis, size in enumerate(target)]
        except IndexError:
            raise UnsupportedNode(f"shape {target} copies an axis that the input {list(x.shape)} lacks") from None
    known = math.prod(size for size in target if size != -1)
    size = math.prod(x.shape)
    fits = known and size % known == 0 if target.count(-1) == 1 else known == size and -1 not in target
    if not fits:
        raise UnsupportedNode(
            f"a tensor of shape {list(x.shape)} cannot take the shape {target}",
            "export with a dynamic number of points, and reshape relative to it (-1 in its place)",
        )
    return rearrange(x, lambda array: array.reshape(target))


def flatten(_context: Context, node: Node) -> Movable:
    """Flatten to a matrix."""
    x = node.tensor(0)
    axis = int(node.attribute("axis", 1))
    axis = axis + len(x.shape) if axis < 0 else axis
    return rearrange(x, lambda array: array.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:])))


def squeeze(_context: Context, node: Node) -> Movable:
    """Squeeze the given axes, or all of size one."""
    x = node.tensor(0)
    axes = node.integers(1, "axes", "list of axes")
    if axes is None:
        axes = [axis for axis, size in enumerate(x.shape) if size == 1]
    chosen = tuple(normal_axis(axis, len(x.shape)) for axis in axes)
    return rearrange(x, lambda array: np.squeeze(array, chosen))


def unsqueeze(_context: Context, node: Node) -> Movable:
    """Insert axes of size one."""
    x = node.tensor(0)
    axes = node.integers(1, "axes", "list of axes") or []
    rank = len(x.shape) + len(axes)
    chosen = tuple(normal_axis(axis, rank) for axis in axes)
    return rearrange(x, lambda array: np.expand_dims(array, chosen))


def transpose(_context: Context, node: Node) -> Movable:
    """Transpose, reversing the axes by default."""
    perm = node.attribute("perm")
    return rearrange(node.tensor(0), lambda array: np.transpose(array, perm))


def expand(_context: Context, node: Node) -> Movable:
    """Broadcast to a shape."""
    x = node.tensor(0)
    shape = np.broadcast_shapes(x.shape, tuple(int(n) for n in np.ravel(node.constant(1, "shape"))))
    check_size(shape)
    return rearrange(x, lambda array: np.broadcast_to(array, shape))


def tile(_context: Context, node: Node) -> Movable:
    """Repeat along every axis."""
    x = node.tensor(0)
    repeats = [int(n) for n in np.ravel(node.constant(1, "count of repeats"))]
    if len(repeats) != len(x.shape):
        raise UnsupportedNode(f"{len(repeats)} repeats do not fit the shape {list(x.shape)}")
    check_size([n * size for n, size in zip(repeats, x.shape, strict=True)])
    return rearrange(x, lambda array: np.tile(array, repeats))


def concat(_context: Context, node: Node) -> Movable:
    """Concat along an axis."""
    parts = [node.tensor(index) for index in range(len(node.inputs))]
    axis = int(node.attribute("axis", 1))
    return concatenate(parts, normal_axis(axis, len(parts[0].shape)))


def slice_by_attributes(_context: Context, node: Node) -> Movable:
    """Slice before opset 10."""
    starts, ends = node.attribute("starts", []), node.attribute("ends", [])
    return _slice(node.tensor(0), starts, ends, node.attribute("axes"), None)


def slice_by_inputs(_context: Context, node: Node) -> Movable:
    """Slice from opset 10 on."""
    starts, ends = (node.integers(i, "", "range") or [] for i in (1, 2))
    return _slice(node.tensor(0), starts, ends, node.integers(3, "", "list of axes"), node.integers(4, "", "step"))


def _slice(
    x: Movable, starts: Sequence[int], ends: Sequence[int], axes: Sequence[int] | None, steps: Sequence[int] | None
) -> Movable:
    axes = list(range(len(starts))) if axes is None else axes
    steps = [1] * len(starts) if steps is None else steps
    index = [slice(None)] * len(x.shape)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        axis = normal_axis(axis, len(x.shape))
        size = x.shape[axis]
        # ONNX clamps to the axis where Python, going backwards, would read -1 as the last element.
        last, before = (size, 0) if step > 0 else (size - 1, -1)
        start = min(max(start + size if start < 0 else start, 0), last)
        end = min(max(end + size if end < 0 else end, before), last)
        index[axis] = slice(start, end if end >= 0 else None, step)
    return rearrange(x, lambda array: array[tuple(index)])


def split(_context: Context, node: Node) -> tuple[Movable, ...]:
    """Parts of given sizes, or equal parts, of which the last may be smaller from opset 18 on."""
    x = node.tensor(0)
    axis = normal_axis(int(node.attribute("axis", 0)), len(x.shape))
    sizes = node.integers(1, "split", "list of sizes")
    if sizes is None:
        count = int(node.attribute("num_outputs", node.n_outputs))
        largest = -(-x.shape[axis] // count)
        sizes = [min(largest, max(x.shape[axis] - i * largest, 0)) for i in range(count)]
    if sum(sizes) != x.shape[axis] or len(sizes) < node.n_outputs:
        raise UnsupportedNode(
            f"parts of sizes {sizes} do not fit an axis of {x.shape[axis]} in {node.n_outputs} outputs"
        )
    ends = np.cumsum(sizes)
    return tuple(part(x, axis, end - size, size) for end, size in zip(ends.tolist(), sizes, strict=True))


def shape(_context: Context, node: Node) -> Constant:
    """The sizes of the axes from ``start`` to ``end``."""
    sizes = np.array(node.tensor(0).shape, np.int64)
    start, end = int(node.attribute("start", 0)), node.attribute("end")
    return Constant(sizes[start : None if end is None else int(end)], INT64)


def size(_context: Context, node: Node) -> Constant:
    """The number of elements."""
    return Constant(np.asarray(math.prod(node.tensor(0).shape), np.int64), INT64)


def constant(_context: Context, node: Node) -> Constant:
    """A constant given by one of several attributes."""
    for name, dtype in _NUMBERS.items():
        if node.attribute(name) is not None:
            return Constant.of(np.asarray(node.attribute(name), dtype))
    value = node.attribute("value")
    if not isinstance(value, Constant):
        raise UnsupportedNode("its value is not a dense numerical tensor")
    return value


def constant_of_shape(_context: Context, node: Node) -> Constant:
    """A tensor of one repeated number."""
    sizes = tuple(int(n) for n in np.ravel(node.constant(0, "shape")))
    check_size(sizes)
    value = node.attribute("value") or Constant.of(np.zeros(1, np.float32))
    return Constant(np.full(sizes, value.array.reshape(-1)[0]), value.dtype)


def arange(_context: Context, node: Node) -> Constant:
    """Range."""
    start, limit, delta = (np.ravel(node.constant(i, "range"))[0] for i in range(3))
    check_size((max(math.ceil((limit - start) / delta), 0),))
    return Constant.of(np.arange(start, limit, delta), node.tensor(0).dtype)


def triangle(_context: Context, node: Node) -> Movable:
    """Trilu: the other half becomes zero."""
    x = node.tensor(0)
    diagonal = int(np.ravel(node.constant(1, "diagonal"))[0]) if node.has(1) else 0
    keep = np.triu if node.attribute("upper", 1) else np.tril
    if isinstance(x, Constant):
        return Constant(keep(x.array, diagonal), x.dtype)
    mask = keep(np.ones(x.shape, np.bool_), diagonal)
    return fill(x, np.where(mask, np.arange(x.size).reshape(x.shape), -1), 0.0)


def fill(x: Tensor, index: np.ndarray, value: float) -> Tensor:
    """The elements at flat positions ``index``, and ``value`` where it is negative."""
    extended = lift(concatenate([x.reshape(-1), Constant.of(np.full(1, value))], 0))
    return extended.take(np.where(index >= 0, index, x.size)).with_dtype(x.dtype)


def pad_by_attributes(_context: Context, node: Node) -> Movable:
    """Pad before opset 11."""
    pads = node.attribute("pads") or node.attribute("paddings") or []
    return _pad(node, list(range(len(node.tensor(0).shape))), pads, float(node.attribute("value", 0.0)))


def pad_by_inputs(_context: Context, node: Node) -> Movable:
    """Pad from opset 11 on."""
    pads = node.integers(1, "", "list of pads") or []
    value = float(np.ravel(node.constant(2, "padding value"))[0]) if node.has(2) else 0.0
    axes = node.integers(3, "", "list of axes")
    return _pad(node, list(range(len(node.tensor(0).shape))) if axes is None else axes, pads, value)


def _pad(node: Node, axes: Sequence[int], pads: Sequence[int], value: float) -> Movable:
    x = node.tensor(0)
    if len(pads) != 2 * len(axes):
        raise UnsupportedNode(f"{len(pads)} pads do not fit {len(axes)} axes")
    widths = [(0, 0)] * len(x.shape)
    for i, axis in enumerate(axes):
        widths[normal_axis(axis, len(x.shape))] = (pads[i], pads[len(axes) + i])
    check_size([size + max(sum(width), 0) for size, width in zip(x.shape, widths, strict=True)])
    crop = tuple(
        slice(max(-before, 0), size - max(-after, 0)) for size, (before, after) in zip(x.shape, widths, strict=True)
    )
    grow = [(max(before, 0), max(after, 0)) for before, after in widths]
    mode = node.attribute("mode", "constant")
    if mode == "constant":
        index = np.pad(np.arange(math.prod(x.shape)).reshape(x.shape)[crop], grow, constant_values=-1)
        if isinstance(x, Tensor):
            return fill(x, index, value)
        return Constant(np.pad(x.array[crop], grow, constant_values=value), x.dtype)
    if mode not in ("reflect", "edge", "wrap"):
        raise UnsupportedNode(f"mode {mode!r} is not defined; constant, reflect, edge and wrap are")
    return rearrange(x, lambda array: np.pad(array[crop], grow, mode=mode))


def depth_to_space(_context: Context, node: Node) -> Movable:
    """Move channels into blocks of space."""
    x = node.tensor(0)
    n, c, h, w = x.shape
    block = int(node.attribute("blocksize"))
    if node.attribute("mode", "DCR") == "DCR":
        split_shape, order = (n, block, block, c // block**2, h, w), (0, 3, 4, 1, 5, 2)
    else:
        split_shape, order = (n, c // block**2, block, block, h, w), (0, 1, 4, 2, 5, 3)
    merged = (n, c // block**2, h * block, w * block)
    return rearrange(x, lambda array: array.reshape(split_shape).transpose(order).reshape(merged))


def space_to_depth(_context: Context, node: Node) -> Movable:
    """Move blocks of space into channels."""
    x = node.tensor(0)
    n, c, h, w = x.shape
    block = int(node.attribute("blocksize"))
    split_shape = (n, c, h // block, block, w // block, block)
    order = (0, 3, 5, 1, 2, 4) if node.attribute("mode", "DCR") == "DCR" else (0, 1, 3, 5, 2, 4)
    merged = (n, c * block**2, h // block, w // block)
    return rearrange(x, lambda array: array.reshape(split_shape).transpose(order).reshape(merged))


LOWERINGS: Table = {
    "Identity": same(identity, on_constants=True),
    "Dropout": same(dropout, on_constants=True),
    "Reshape": same(reshape, on_constants=True),
    "Flatten": same(flatten, on_constants=True),
    "Squeeze": same(squeeze, on_constants=True),
    "Unsqueeze": same(unsqueeze, on_constants=True),
    "Transpose": same(transpose, on_constants=True),
    "Expand": same(expand, 8, on_constants=True),
    "Tile": same(tile, 6, on_constants=True),
    "Concat": same(concat, on_constants=True),
    "Slice": [
        Lowering(1, slice_by_attributes, on_constants=True),
        Lowering(10, slice_by_inputs, on_constants=True),
    ],
    "Split": same(split, 2, on_constants=True),
    "Shape": same(shape, on_constants=True),
    "Size": same(size, on_constants=True),
    "Constant": same(constant, on_constants=True),
    "ConstantOfShape": same(constant_of_shape, 9, on_constants=True),
    "Range": same(arange, 11, on_constants=True),
    "Trilu": same(triangle, 14, on_constants=True),
    "Pad": [Lowering(1, pad_by_attributes, on_constants=True), Lowering(11, pad_by_inputs, on_constants=True)],
    "DepthToSpace": same(depth_to_space, on_constants=True),
    "SpaceToDepth": same(space_to_depth, on_constants=True),
}
