"""Quantised weights: what they compute, exactly."""

from __future__ import annotations

import numpy as np

from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.reduction import normal_axis
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, is_float
from mn_onnx.symbolic.linear import matmul


def dequantize(_context: Context, node: Node) -> Constant:
    """``(x - zero_point) * scale``, per tensor, per axis, or per block along an axis, exactly."""
    x = node.tensor(0)
    if isinstance(x, Tensor):
        raise UnsupportedNode(
            "it reads quantised data that depend on the points",
            "quantise the weights only, or export without quantisation",
        )
    scale = np.asarray(node.constant(1, "scale"), np.float64)
    zero = np.asarray(node.constant(2, "zero point"), np.float64) if node.has(2) else np.zeros(())
    values = np.asarray(x.array, np.float64)
    if scale.size > 1:
        axis = normal_axis(int(node.attribute("axis", 1)), values.ndim)
        block = int(node.attribute("block_size", 0))
        scale, zero = (spread(part, values.shape, axis, block) for part in (scale, zero))
    else:
        scale, zero = scale.reshape(()), zero.reshape(-1)[0] if zero.size else np.zeros(())
    real = node.tensor(1).dtype
    return Constant((values - zero) * scale, real if is_float(real) else np.dtype(np.float32))


def spread(part: np.ndarray, shape: tuple[int, ...], axis: int, block: int) -> np.ndarray:
    """Scales or zero points in the shape of the data."""
    if part.size == 1:
        return part.reshape(())
    if part.ndim == 1 and not block:
        return part.reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return np.repeat(part, block, axis)[tuple(slice(size) for size in shape)]


def unpacked(packed: np.ndarray, bits: int) -> np.ndarray:
    """Unsigned integers of ``bits`` bits from bytes, lowest bits first, along the last axis."""
    shifts = np.arange(0, 8, bits, dtype=np.uint8)
    digits = (packed[..., None].astype(np.uint8) >> shifts) & (2**bits - 1)
    return np.asarray(digits.reshape(*packed.shape[:-1], -1), np.float64)


def matmul_of_packed_weights(context: Context, node: Node) -> Constant | Tensor:
    """MatMulNBits of onnxruntime: ``x @ W.T + bias``, with weights in blocks of ``block_size`` along their rows."""
    columns, rows = int(node.attribute("K")), int(node.attribute("N"))
    bits, block = int(node.attribute("bits", 4)), int(node.attribute("block_size"))
    if int(node.attribute("accuracy_level", 0)) == 4:
        raise UnsupportedNode(
            "accuracy_level 4 rounds its data to 8 bits", "quantise with accuracy_level 0 or 1, or export before that"
        )
    if bits not in (2, 4, 8) or node.has(4):
        raise UnsupportedNode(
            f"weights of {bits} bits{' with a group index' if node.has(4) else ''} are not supported",
            "export the network before this quantisation",
        )
    n_blocks = -(-columns // block)
    values = unpacked(node.constant(1, "weights"), bits).reshape(rows, n_blocks, block)
    scales = np.asarray(node.constant(2, "scales"), np.float64).reshape(rows, n_blocks, 1)
    zeros = np.full((rows, n_blocks, 1), 2.0 ** (bits - 1))
    if node.has(3):
        stored = node.constant(3, "zero points")
        plain = stored if is_float(node.tensor(3).dtype) else unpacked(stored.reshape(rows, -1), bits)
        zeros = np.asarray(plain, np.float64).reshape(rows, -1)[:, :n_blocks, None]
    weights = ((values - zeros) * scales).reshape(rows, -1)[:, :columns]
    bias = node.optional(5, "bias")
    return matmul(
        context.algebra, node.tensor(0), Constant.of(weights.T), None if bias is None else np.asarray(bias, np.float64)
    )


LOWERINGS: Table = {"DequantizeLinear": same(dequantize, 10, on_constants=True)}
