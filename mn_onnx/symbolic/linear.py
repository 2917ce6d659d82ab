"""Contraction of symbolic tensors with constant weights: the one place where new affine rows are computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.symbolic import CONSTANT, NO_POINT, Constant, Tensor, check_size, join, lift
from mn_onnx.symbolic.algebra import Algebra

Floats = NDArray[np.float64]


def contract(algebra: Algebra, x: Tensor, weights: Floats, bias: Floats | None = None) -> Tensor:
    """``x @ weights + bias`` for ``x`` [r, k], ``weights`` [k, j], ``bias`` [j].

    Rows of ``x`` that hold the same functions, as those of different points do, are computed once.
    """
    if not np.isfinite(weights).all():
        raise ValueError("a weight is not a finite number (NaN or infinity)")
    r, j = x.shape[0], weights.shape[1]
    check_size((r, j))
    x = algebra.settle(x)
    of_a_point = x.live & (x.point != NO_POINT)
    fields = [np.zeros((r, j), dtype) for dtype in (np.int32, np.int64, np.int32, np.float64, np.float64)]
    point, base, function, scale, offset = fields
    if of_a_point.any():
        highest = np.where(of_a_point, x.point, NO_POINT).max(axis=1)
        lowest = np.where(of_a_point, x.point, highest[:, None]).min(axis=1)
        lone = lowest == highest
    else:
        lowest, lone = np.full(r, NO_POINT), np.ones(r, np.bool_)
    for members in _alike(x, lone):
        first = members[0]
        row = x[first]
        base[members], function[members], scale[members], offset[members] = _contract_row(algebra, row, weights, bias)
        if lone[first]:
            point[members] = lowest[members, None]
        else:
            touched = (weights != 0.0) & of_a_point[first][:, None]
            for column in range(j):
                points = np.unique(row.point[touched[:, column]])
                point[members, column] = points[0] if points.size else NO_POINT
                if points.size > 1 and base[first, column] >= CONSTANT:
                    base[members, column] = algebra.refuse_mixing()
    point[base == CONSTANT] = NO_POINT
    return Tensor(point, base, function, scale, offset, x.dtype)


def _alike(x: Tensor, lone: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Groups of rows [r, k] with equal functions; rows that mix points (not ``lone``) must be wholly equal."""
    r = x.shape[0]
    fields = (x.base, x.function, x.scale, x.offset)
    if r and lone.all() and all((field == field[0]).all() for field in fields):
        return [np.arange(r)]
    members: dict[tuple[bytes, ...], list[int]] = {}
    for i in range(r):
        key = tuple(field[i].tobytes() for field in fields)
        members.setdefault(key if lone[i] else (*key, x.point[i].tobytes()), []).append(i)
    return [np.array(group) for group in members.values()]


def _contract_row(
    algebra: Algebra, row: Tensor, weights: Floats, bias: Floats | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, Floats]:
    refused = row.refused
    good = row[~refused]
    rows = algebra.store.rows(good, algebra.node)
    total = rows.combined(weights[~refused].T, 0.0 if bias is None else bias)
    base, function, scale, offset = algebra.store.elements(total)
    if refused.any():
        reached = weights[refused] != 0.0
        for column in np.flatnonzero(reached.any(axis=0)).tolist():
            base[column] = algebra.store.refuse_together(row.base[refused][reached[:, column]])
    return base, function, scale, offset


def matmul(
    algebra: Algebra, x: Constant | Tensor, y: Constant | Tensor, bias: Floats | None = None
) -> Constant | Tensor:
    """Matrix product with numpy's broadcasting; ``bias`` [n] is added to the last axis.

    Raises `ValueError` if the shapes do not fit.
    """
    if len(x.shape) == 1:
        product = matmul(algebra, _reshape(x, (1, *x.shape)), y, bias)
        return _reshape(product, product.shape[:-2] + product.shape[-1:])
    if len(y.shape) == 1:
        product = matmul(algebra, x, _reshape(y, (*y.shape, 1)), bias)
        return _reshape(product, product.shape[:-1])
    if x.shape[-1] != y.shape[-2]:
        raise ValueError(f"shapes {list(x.shape)} and {list(y.shape)} do not fit a matrix product")
    batch = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
    shape = (*batch, x.shape[-2], y.shape[-1])
    check_size(shape)
    if isinstance(x, Constant) and isinstance(y, Constant):
        product = np.matmul(x.array, y.array)
        return Constant(product if bias is None else product + bias, x.dtype)
    if isinstance(y, Constant):
        return _product_with_constant(algebra, lift(x), np.asarray(y.array, np.float64), bias, batch)
    if isinstance(x, Constant):
        left = np.swapaxes(np.asarray(x.array, np.float64), -1, -2)
        right = lift(y).map(lambda field: np.swapaxes(field, -1, -2))
        product = _product_with_constant(algebra, right, left, None, batch).map(lambda f: np.swapaxes(f, -1, -2))
        return product if bias is None else algebra.add(product, lift(Constant.of(bias)))
    return _product_of_tensors(algebra, x, y, bias, shape)


def _product_with_constant(
    algebra: Algebra, x: Tensor, weights: Floats, bias: Floats | None, batch: tuple[int, ...]
) -> Tensor:
    m, k, n = x.shape[-2], x.shape[-1], weights.shape[-1]
    shared = int(np.prod(weights.shape[:-2])) == 1
    if shared:
        x = x.broadcast((*batch, m, k))
        rows = x.reshape(int(np.prod(batch)) * m, k)
        return contract(algebra, rows, weights.reshape(k, n), bias).reshape(*batch, m, n)
    left = x.broadcast((*batch, m, k)).reshape(-1, m, k)
    right = np.broadcast_to(weights, (*batch, k, n)).reshape(-1, k, n)
    parts = [contract(algebra, left[i], right[i], bias) for i in range(len(right))]
    return join(parts, np.stack).reshape(*batch, m, n)


def _product_of_tensors(algebra: Algebra, x: Tensor, y: Tensor, bias: Floats | None, shape: tuple[int, ...]) -> Tensor:
    """A product of two symbolic matrices, of which elementwise one factor may still be a number."""
    k = x.shape[-1]
    check_size((*shape, k))
    left = x.map(lambda field: field[..., :, None, :])
    right = y.map(lambda field: np.swapaxes(field, -1, -2)[..., None, :, :])
    terms = algebra.multiply(left, right).broadcast((*shape, k)).reshape(-1, k)
    total = contract(algebra, terms, np.ones((k, 1))).reshape(*shape)
    return total if bias is None else algebra.add(total, lift(Constant.of(bias)))


def _reshape(value: Constant | Tensor, shape: tuple[int, ...]) -> Constant | Tensor:
    if isinstance(value, Constant):
        return Constant(value.array.reshape(shape), value.dtype)
    return value.reshape(*shape)
