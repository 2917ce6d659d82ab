"""Quantised weights: what DequantizeLinear computes on constants."""

from __future__ import annotations

import numpy as np

from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.reduction import normal_axis
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, is_float


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


LOWERINGS: Table = {"DequantizeLinear": same(dequantize, 10, on_constants=True)}
