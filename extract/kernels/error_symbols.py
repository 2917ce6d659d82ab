"""Radii from every unit's own error, as in zonotopes: errors that reach a row along several ways may cancel.

A radius summed level by level grows with the product of the layers' absolute weights: after eight layers it can be a
hundred times what this gives. The same forms are in Singh et al., Fast and Effective Robustness Certification (NeurIPS
2018). An unstable unit's error is a *symbol* in [-1, 1] times X[SYMBOL_ERROR]; every row has a coefficient for each
symbol before it, and its radius is the sum of their magnitudes. The cost is the cube of the number of units, so this is
for deep systems only, and not for every cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mn_onnx.extract.kernels.lanes import fma, load, magnitude, splat, store, total
from mn_onnx.extract.kernels.memory import (
    ERROR,
    GROWTH,
    LEVEL_OUTPUT,
    LEVEL_SYMBOL,
    RADIUS,
    READ_AT,
    READ_COLS,
    READ_ROW,
    SLOPE,
    SYMBOL_AT,
    SYMBOL_ERROR,
    symbol_stride,
)
from mn_onnx.extract.kernels.products import accumulate_four
from mn_onnx.extract.kernels.relax import MARGIN


@njit(cache=True, error_model="numpy")
def start_errors(F, X, J, M, weights, target, stride, begin, symbols):
    """The errors that four rows read directly: from symbol ``begin`` on each unit's own; no row reads those before."""
    for k in range(4):
        for s in range(begin):
            F[target + k * stride + s] = 0.0
    for s in range(begin, symbols):
        error = X[SYMBOL_ERROR * M + s]
        at = weights + J[SYMBOL_AT * M + s]
        for k in range(4):
            F[target + k * stride + s] = error * F[at + k]


@njit(cache=True, error_model="numpy")
def sum_errors(F, X, M, target, row, symbols):
    """X[RADIUS] of a row: the sum of its errors' magnitudes, with their rounding, at most X[GROWTH]."""
    one, summed = splat(1.0), splat(0.0)
    for s in range(0, symbols, 4):
        summed = fma(one, magnitude(load(F, target + s)), summed)
    growth = X[GROWTH * M + row]
    X[RADIUS * M + row] = min(growth, total(summed) + MARGIN * growth)


@njit(cache=True, error_model="numpy")
def track_errors(F, X, J, M, weights, begin, end, level, first, count, errors, carried, stride, read):
    """Radii of rows ``begin:end`` of a level from the error of every single unit before.

    ``weights``: F's index of the columns. ``first:count``: the outputs that the rows read. The rows' table of errors
    starts at F[errors], the outputs' at F[carried], ``stride`` numbers for each row or output; F[read] is scratch of
    a number for each row and output.
    """
    symbols = J[LEVEL_SYMBOL * M + level]
    # Errors of levels whose outputs no row reads any more come through other outputs only.
    own = 0
    while own < level and J[LEVEL_OUTPUT * M + own + 1] <= first:
        own += 1
    outputs = count - first
    for r in range(begin, end, 4):
        block = read + (r - begin) * outputs
        for p in range(first, count):
            store(F, block + 4 * (p - first), load(F, weights + J[READ_AT * M + p] + r))
        start_errors(F, X, J, M, weights + r, errors + r * stride, stride, J[LEVEL_SYMBOL * M + own], symbols)
    four, blocks = np.int64(4), (end - begin) >> 2
    for earlier in range(level - 1):
        start, stop = J[LEVEL_SYMBOL * M + earlier], J[LEVEL_SYMBOL * M + earlier + 1]
        if start < stop:
            since = max(first, J[LEVEL_OUTPUT * M + earlier + 1])
            accumulate_four(
                F, errors + begin * stride, start, stop, stride, carried, since, count,
                read - 4 * first, four, blocks, 4 * stride, 4 * outputs,
            )  # fmt: skip
    for r in range(begin, end):
        sum_errors(F, X, M, errors + r * stride, r, symbols)


@njit(cache=True, error_model="numpy")
def pass_errors_on(F, X, J, M, level, begin, end, errors, carried, stride):
    """The table of errors of outputs ``begin:end`` of a level, and a symbol for each that has an error of its own."""
    known = J[LEVEL_SYMBOL * M + level]
    symbols = known
    for p in range(begin, end):
        c = J[READ_COLS * M + p]
        slope, zero = splat(X[SLOPE * M + c]), splat(0.0)
        source, target = errors + J[READ_ROW * M + p] * stride, carried + p * stride
        for s in range(0, known, 4):
            store(F, target + s, fma(slope, load(F, source + s), zero))
        X[SYMBOL_ERROR * M + symbols] = X[ERROR * M + c]
        J[SYMBOL_AT * M + symbols] = J[READ_AT * M + p]
        symbols += X[ERROR * M + c] > 0.0
    while symbols & 7:
        X[SYMBOL_ERROR * M + symbols] = 0.0
        J[SYMBOL_AT * M + symbols] = J[SYMBOL_AT * M + symbols - 1]
        symbols += 1
    J[LEVEL_OUTPUT * M + level + 1] = end
    J[LEVEL_SYMBOL * M + level + 1] = symbols


@njit(cache=True, error_model="numpy")
def tracking_floats(rows, cols, levels):
    """Number of float64 that the tables of errors of a system take in scratch."""
    return (rows + cols) * symbol_stride(cols, levels) + rows * cols + 8
