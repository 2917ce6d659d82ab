"""Lowering of gathers and scatters with constant indices."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.reduction import normal_axis
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, check_size, concatenate, lift, lower, rearrange
from mn_onnx.symbolic.algebra import Algebra

Movable = Constant | Tensor
Indices = NDArray[np.int64]

COMBINE: dict[str, Callable[[Algebra, Tensor, Tensor], Tensor]] = {
    "add": Algebra.add,
    "mul": Algebra.multiply,
    "max": lambda algebra, x, y: algebra.extremum(x, y, "maximum"),
    "min": lambda algebra, x, y: algebra.extremum(x, y, "minimum"),
}


def indices_of(node: Node, index: int = 1) -> Indices:
    """Integer indices, which must be constant."""
    return np.asarray(node.constant(index, "list of indices")).astype(np.int64)


def wrapped(indices: Indices, size: int) -> Indices:
    """Negative indices counted from the end. Raises `UnsupportedNode` outside the axis."""
    if indices.size and not (-size <= indices.min() and indices.max() < size):
        raise UnsupportedNode(f"an index lies outside the axis of {size}")
    return np.where(indices < 0, indices + size, indices)


def gather(_context: Context, node: Node) -> Movable:
    """Gather along an axis."""
    x = node.tensor(0)
    axis = normal_axis(int(node.attribute("axis", 0)), len(x.shape))
    indices = wrapped(indices_of(node), x.shape[axis])
    check_size((indices.size, math.prod(x.shape) // max(x.shape[axis], 1)))
    return rearrange(x, lambda array: np.take(array, indices, axis))


def gather_elements(_context: Context, node: Node) -> Movable:
    """GatherElements along an axis."""
    x = node.tensor(0)
    axis = normal_axis(int(node.attribute("axis", 0)), len(x.shape))
    indices = wrapped(indices_of(node), x.shape[axis])
    region = tuple(slice(size if i != axis else None) for i, size in enumerate(indices.shape))
    return rearrange(x, lambda array: np.take_along_axis(array[region], indices, axis))


def gather_nd(_context: Context, node: Node) -> Movable:
    """GatherND behind ``batch_dims`` shared axes."""
    x = node.tensor(0)
    indices = indices_of(node)
    batch = int(node.attribute("batch_dims", 0))
    depth = indices.shape[-1]
    lead = [
        np.arange(size).reshape([-1 if i == axis else 1 for i in range(indices.ndim - 1)])
        for axis, size in enumerate(x.shape[:batch])
    ]
    picks = [wrapped(indices[..., i], x.shape[batch + i]) for i in range(depth)]
    check_size((math.prod(indices.shape[:-1]), math.prod(x.shape[batch + depth :])))
    return rearrange(x, lambda array: array[tuple(lead + picks)])


def scatter_elements(context: Context, node: Node) -> Movable:
    """ScatterElements, and Scatter of old opsets."""
    x, updates = node.tensor(0), node.tensor(2)
    axis = normal_axis(int(node.attribute("axis", 0)), len(x.shape))
    indices = wrapped(indices_of(node), x.shape[axis])
    places = np.indices(indices.shape)
    places[axis] = indices
    flat = np.asarray(np.ravel_multi_index(tuple(places), x.shape), np.int64)
    return _scatter(context, node, x, flat, updates)


def scatter_nd(context: Context, node: Node) -> Movable:
    """ScatterND."""
    x, updates = node.tensor(0), node.tensor(2)
    indices = indices_of(node)
    depth = indices.shape[-1]
    positions = np.arange(math.prod(x.shape)).reshape(x.shape)
    picks = tuple(wrapped(indices[..., i], x.shape[i]) for i in range(depth))
    return _scatter(context, node, x, positions[picks], updates)


def _scatter(context: Context, node: Node, x: Movable, flat: Indices, updates: Movable) -> Movable:
    """``x`` with ``updates`` at flat positions ``flat``, joined with the old elements if the node says so."""
    if flat.shape != updates.shape:
        raise UnsupportedNode(f"updates of shape {list(updates.shape)} do not fit indices for {list(flat.shape)}")
    reduction = node.attribute("reduction", "none")
    if reduction != "none" and reduction not in COMBINE:
        raise UnsupportedNode(f"reduction {reduction!r} is not defined")
    result, new = lift(rearrange(x, np.ravel)), lift(rearrange(updates, np.ravel))
    places = flat.reshape(-1)
    waiting = np.arange(places.size)
    while waiting.size:
        # Several updates of one place are joined one after the other.
        _, first = np.unique(places[waiting], return_index=True)
        now = waiting[first]
        value = new[now]
        if reduction != "none":
            value = COMBINE[reduction](context.algebra, result[places[now]], value)
        chosen = np.arange(result.size)
        chosen[places[now]] = result.size + np.arange(now.size)
        result = lift(concatenate([result, value], 0)).take(chosen)
        waiting = np.delete(waiting, first)
    return lower(result.reshape(*x.shape).with_dtype(x.dtype))


def compress(_context: Context, node: Node) -> Movable:
    """The elements or slices where the condition holds."""
    x = node.tensor(0)
    keep = np.flatnonzero(node.constant(1, "condition"))
    axis = node.attribute("axis")
    if axis is None:
        return rearrange(x, lambda array: array.reshape(-1)[keep])
    return rearrange(x, lambda array: np.take(array, keep, normal_axis(int(axis), len(x.shape))))


def reverse_sequence(_context: Context, node: Node) -> Movable:
    """Reverse the first elements along the time axis, as many as each batch entry says."""
    x = node.tensor(0)
    lengths = indices_of(node)
    time, batch = int(node.attribute("time_axis", 0)), int(node.attribute("batch_axis", 1))
    positions = np.moveaxis(np.arange(math.prod(x.shape)).reshape(x.shape), (batch, time), (0, 1)).copy()
    for i, length in enumerate(lengths.tolist()):
        positions[i, :length] = positions[i, :length][::-1].copy()
    index = np.moveaxis(positions, (0, 1), (batch, time))
    return rearrange(x, lambda array: array.reshape(-1)[index])


def one_hot(_context: Context, node: Node) -> Constant:
    """OneHot of constant indices."""
    indices, depth = indices_of(node, 0), int(np.ravel(node.constant(1, "depth"))[0])
    check_size((*indices.shape, depth))
    off, on = node.constant(2, "pair of values")
    hit = (np.where(indices < 0, indices + depth, indices)[..., None]) == np.arange(depth)
    axis = normal_axis(int(node.attribute("axis", -1)), indices.ndim + 1)
    return Constant.of(np.moveaxis(np.where(hit, on, off), -1, axis), node.tensor(2).dtype)


LOWERINGS: Table = {
    "Gather": same(gather, on_constants=True),
    "GatherElements": same(gather_elements, 11, on_constants=True),
    "GatherND": same(gather_nd, 11, on_constants=True),
    "Scatter": same(scatter_elements, 9, on_constants=True),
    "ScatterElements": same(scatter_elements, 11, on_constants=True),
    "ScatterND": same(scatter_nd, 11, on_constants=True),
    "Compress": same(compress, 9, on_constants=True),
    "ReverseSequence": same(reverse_sequence, 10, on_constants=True),
    "OneHot": same(one_hot, 9, on_constants=True),
}
