"""Small operations on flat symbolic tensors and on scalar expressions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.symbolic import CONSTANT, IDENTITY, NO_POINT, Tensor

Mask = NDArray[np.bool_]


def affine(expression: Expression, scale: float, offset: float) -> Expression:
    """``scale * expression + offset``, without operations that do nothing."""
    if expression.op == "constant":
        return constant(scale * expression.value + offset)
    if scale == -1.0:
        expression = apply("negate", expression)
    elif scale != 1.0:
        expression = apply("multiply", constant(scale), expression)
    return expression if offset == 0.0 else apply("add", expression, constant(offset))


def substitute(expression: Expression, inner: Expression) -> Expression:
    """``expression`` with ``inner`` in place of its variable."""
    if inner == T or not expression.arguments:
        return inner if expression == T else expression
    return Expression(expression.op, tuple(substitute(a, inner) for a in expression.arguments), expression.value)


def empty(n: int, dtype: np.dtype) -> Tensor:
    """``n`` zeros."""
    point, base = np.full(n, NO_POINT, np.int32), np.full(n, CONSTANT, np.int64)
    return Tensor(point, base, np.zeros(n, np.int32), np.zeros(n), np.zeros(n), dtype)


def copy(x: Tensor) -> Tensor:
    """A tensor whose elements can be overwritten."""
    return x.map(lambda field: field.copy())


def assign(target: Tensor, mask: Mask, source: Tensor, *, packed: bool = False) -> None:
    """Overwrite elements of ``target`` at ``mask`` by those of ``source``, which holds only these if ``packed``."""
    for name in ("point", "base", "function", "scale", "offset"):
        values = getattr(source, name)
        getattr(target, name)[mask] = values if packed else values[mask]


def drop_zero_scales(x: Tensor) -> Tensor:
    """Turn elements that no longer depend on the point into numbers (``x`` is changed)."""
    gone = x.live & (x.scale == 0.0)
    x.base[gone], x.function[gone], x.point[gone] = CONSTANT, IDENTITY, NO_POINT
    return x
