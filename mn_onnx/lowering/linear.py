"""Lowering of matrix products, convolutions and inference-time batch normalisation."""

from __future__ import annotations

import math

import numpy as np

from mn_onnx.lowering.activation import number
from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.table import Lowering, Table, same
from mn_onnx.lowering.windows import Windows, gather_windows
from mn_onnx.symbolic import Constant, Tensor, concatenate, lift, rearrange
from mn_onnx.symbolic.linear import matmul as product


def gemm(context: Context, node: Node) -> Constant | Tensor:
    """``alpha * A' @ B' + beta * C``; ``C`` is broadcast, and absent from opset 11 on where it is not needed."""
    alpha, beta = float(node.attribute("alpha", 1.0)), float(node.attribute("beta", 1.0))
    a, b = node.tensor(0), node.tensor(1)
    if len(a.shape) != 2 or len(b.shape) != 2:
        raise UnsupportedNode(f"its operands have shapes {list(a.shape)} and {list(b.shape)}, not two axes each")
    if node.attribute("transA", 0):
        a = rearrange(a, np.transpose)
    if node.attribute("transB", 0):
        b = rearrange(b, np.transpose)
    c = node.tensor(2) if node.has(2) and beta != 0.0 else None
    if isinstance(b, Constant) and (c is None or _is_row(c, b.shape[1])):
        weights = Constant.of(alpha * np.asarray(b.array, np.float64), b.dtype)
        bias = None if c is None else np.broadcast_to(beta * lift(c).offset.reshape(-1), b.shape[1:])
        return product(context.algebra, a, weights, bias)
    total = scaled(context, product(context.algebra, a, b), alpha)
    return total if c is None else context.algebra.add(total, scaled(context, c, beta))


def _is_row(c: Constant | Tensor, columns: int) -> bool:
    """Whether ``c`` is the same constant row for all rows of a matrix."""
    return isinstance(c, Constant) and c.array.size in (1, columns) and c.shape[:-1] in ((), (1,))


def scaled(context: Context, x: Constant | Tensor, factor: float) -> Tensor:
    """``factor * x``."""
    return lift(x) if factor == 1.0 else context.algebra.multiply(lift(x), lift(Constant.of(np.asarray(factor))))


def matmul(context: Context, node: Node) -> Constant | Tensor:
    """MatMul."""
    return product(context.algebra, node.tensor(0), node.tensor(1))


def convolution(context: Context, node: Node) -> Tensor:
    """Convolution over any number of spatial axes, of which all but kernel-1 ones usually mix points."""
    x = node.tensor(0)
    weights = np.asarray(node.constant(1, "kernel"), np.float64)
    bias = node.optional(2, "bias")
    if len(x.shape) < 3 or len(x.shape) != weights.ndim:
        raise UnsupportedNode(f"input {list(x.shape)} and kernel {list(weights.shape)} do not fit a convolution")
    group = int(node.attribute("group", 1))
    n_out, per_group, *kernel = weights.shape
    if group < 1 or n_out % group or x.shape[1] != per_group * group:
        raise UnsupportedNode(f"input {list(x.shape)} and kernel {list(weights.shape)} do not fit group={group}")
    windows = Windows.of_node(node, x.shape[2:], tuple(kernel))
    patches = gather_windows(lift(x), windows, 0.0).map(lambda field: np.moveaxis(field, 1, 2))
    n, places, _, window = patches.shape
    biases = np.zeros(n_out) if bias is None else np.asarray(bias, np.float64)
    size = n_out // group
    outputs = []
    for g in range(group):
        rows = patches.take(_channels(patches.shape, g * per_group, per_group)).reshape(n * places, per_group * window)
        own = slice(g * size, (g + 1) * size)
        result = product(context.algebra, rows, Constant.of(weights[own].reshape(size, -1).T), biases[own])
        outputs.append(rearrange(result, lambda array: np.moveaxis(array.reshape(n, places, size), 1, 2)))
    return lift(concatenate(outputs, 1)).reshape(x.shape[0], n_out, *windows.places)


def _channels(shape: tuple[int, ...], first: int, count: int) -> np.ndarray:
    """Flat positions of ``count`` channels, the third axis of patches."""
    return np.arange(math.prod(shape)).reshape(shape)[:, :, first : first + count]


def transposed_convolution(context: Context, node: Node) -> Tensor:
    """ConvTranspose with a kernel of one element, which is a matrix product per place."""
    x = node.tensor(0)
    weights = np.asarray(node.constant(1, "kernel"), np.float64)
    if (
        math.prod(weights.shape[2:]) != 1
        or set(node.attribute("strides", [1])) != {1}
        or any(node.attribute("pads", []))
    ):
        raise UnsupportedNode(
            "it spreads every point over its neighbours; only kernels of size 1 with stride 1 act on single points"
        )
    group = int(node.attribute("group", 1))
    n_in, per_group = weights.shape[:2]
    dense = np.zeros((n_in, per_group * group))
    for g in range(group):
        rows = slice(g * n_in // group, (g + 1) * n_in // group)
        dense[rows, g * per_group : (g + 1) * per_group] = weights[rows, :, ...].reshape(-1, per_group)
    last = rearrange(x, lambda array: np.moveaxis(array, 1, -1))
    bias = node.optional(2, "bias")
    result = product(context.algebra, last, Constant.of(dense), None if bias is None else np.asarray(bias, np.float64))
    return lift(rearrange(result, lambda array: np.moveaxis(array, -1, 1)))


def batch_normalization(context: Context, node: Node) -> Tensor:
    """``scale * (x - mean) / sqrt(variance + epsilon) + bias`` per channel, with stored statistics."""
    training = node.attribute("training_mode", 0) if node.version >= 14 else node.n_outputs > 1
    if node.version < 7:
        training = not node.attribute("is_test", 0)
    if training and (node.version >= 14 or any(node.wants(i) for i in range(1, node.n_outputs))):
        raise UnsupportedNode(
            "in training mode it uses the statistics of the batch, so a value depends on the other points",
            "call model.eval() before the export, or export with training=TrainingMode.EVAL",
        )
    x = lift(node.tensor(0))
    names = ("scale", "bias", "mean", "variance")
    scale, bias, mean, variance = (np.asarray(node.constant(i, name), np.float64) for i, name in enumerate(names, 1))
    factor = scale / np.sqrt(variance + number(node, "epsilon", 1e-5))
    shift = bias - mean * factor
    if not (np.isfinite(factor).all() and np.isfinite(shift).all()):
        raise UnsupportedNode("its stored statistics are not finite numbers")
    if len(x.shape) > 1 and scale.ndim == 1:
        if x.shape[1] != scale.size:
            raise UnsupportedNode(f"{scale.size} channels of statistics do not fit the input {list(x.shape)}")
        shape = (-1, *([1] * (len(x.shape) - 2)))
        factor, shift = factor.reshape(shape), shift.reshape(shape)
    algebra = context.algebra
    return algebra.add(algebra.multiply(x, lift(Constant.of(factor))), lift(Constant.of(shift)))


LOWERINGS: Table = {
    "Gemm": same(gemm, on_constants=True),
    "MatMul": same(matmul, on_constants=True),
    "Conv": same(convolution),
    "ConvTranspose": same(transposed_convolution),
    "BatchNormalization": [Lowering(1, batch_normalization)],
}
