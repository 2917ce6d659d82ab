"""Radii from every unit's own error, as in zonotopes: errors that reach a row along several ways may cancel.

A radius summed level by level grows with the product of the layers' absolute weights: after eight layers it can be a
hundred times what this gives. The same forms are in Singh et al., Fast and Effective Robustness Certification (NeurIPS
2018). The error of an unstable unit is a *symbol*, a value in [-1, 1]; every row has a coefficient for each symbol
before it, and its radius is the sum of their magnitudes. The cost is the cube of the number of units, so this is for
deep systems only, and not for every cell.

The tables are float32, and the radius is enlarged by the most that their rounding can have taken away: the magnitudes
of all that is summed add up to no more than X[GROWTH], so n roundings in a row take at most n halves of a unit in the
last place of that (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mn_onnx.extract.kernels.lanes import (
    as_singles,
    fma,
    load,
    load_singles,
    magnitude,
    round_to_singles,
    splat_singles,
    store,
    total,
)
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
    symbol_stride,
)
from mn_onnx.extract.kernels.relax import MARGIN

# Half a unit in the last place of float32, and a little for products of several such errors.
ROUNDING = 1.05 * 2.0**-24
# Errors are tracked as long as all of them add up to numbers in this range: there float32 is far from both its ends.
SMALLEST, LARGEST = 2.0**-40, 2.0**40
# So many outputs of a tile stay in the nearest cache.
PANEL = 192


@njit(cache=True, error_model="numpy")
def add_tile(E, target, stride, gathered, count, weights, fresh):
    """32 symbols of four rows: what the rows read of ``count`` outputs, added to E[target] unless ``fresh``.

    ``gathered``: the first output's entry of the first symbol; ``weights``: four for each output.
    """
    t1, t2, t3 = target + stride, target + 2 * stride, target + 3 * stride
    zero = splat_singles(np.float32(0.0))
    a0, a1, a2, a3 = zero, zero, zero, zero
    b0, b1, b2, b3 = zero, zero, zero, zero
    if not fresh:
        a0, a1, a2, a3 = load_singles(E, target), load_singles(E, t1), load_singles(E, t2), load_singles(E, t3)
        b0, b1 = load_singles(E, target + 16), load_singles(E, t1 + 16)
        b2, b3 = load_singles(E, t2 + 16), load_singles(E, t3 + 16)
    for _ in range(count):
        u, v = load_singles(E, gathered), load_singles(E, gathered + 16)
        w0, w1 = splat_singles(E[weights]), splat_singles(E[weights + 1])
        w2, w3 = splat_singles(E[weights + 2]), splat_singles(E[weights + 3])
        a0, b0 = fma(w0, u, a0), fma(w0, v, b0)
        a1, b1 = fma(w1, u, a1), fma(w1, v, b1)
        a2, b2 = fma(w2, u, a2), fma(w2, v, b2)
        a3, b3 = fma(w3, u, a3), fma(w3, v, b3)
        gathered += stride
        weights += 4
    store(E, target, a0)
    store(E, t1, a1)
    store(E, t2, a2)
    store(E, t3, a3)
    store(E, target + 16, b0)
    store(E, t1 + 16, b1)
    store(E, t2 + 16, b2)
    store(E, t3 + 16, b3)


@njit(cache=True, error_model="numpy")
def sum_errors(E, X, M, row, target, symbols, rounding):
    """X[RADIUS] of a row: the sum of its errors' magnitudes, with their rounding, at most X[GROWTH]."""
    one, summed = splat_singles(np.float32(1.0)), splat_singles(np.float32(0.0))
    for s in range(0, symbols, 16):
        summed = fma(one, magnitude(load_singles(E, target + s)), summed)
    growth = X[GROWTH * M + row]
    radius = total(summed) + (rounding + MARGIN) * growth
    X[RADIUS * M + row] = radius if radius < growth else growth


@njit(cache=True, error_model="numpy")
def track_errors(F, X, J, M, weights, begin, end, level, first, count, errors, carried, stride, read, rounding):
    """Radii of rows ``begin:end`` of a level from the error of every single unit before.

    ``weights``: F's index of the columns. ``first:count``: the outputs that the rows read. In F as float32, the rows'
    table of errors starts at ``errors``, the outputs' at ``carried``, ``stride`` numbers for each row or output;
    ``read`` is scratch of a number for each row and output. ``rounding``: how many roundings a number of the outputs'
    table may have had, as a share of X[GROWTH]; returns the same of the rows'.
    """
    E = as_singles(F)
    symbols, outputs = J[LEVEL_SYMBOL * M + level], count - first
    for r in range(begin, end, 4):
        block = read + (r - begin) * outputs
        for p in range(first, count):
            store(E, block, round_to_singles(load(F, weights + J[READ_AT * M + p] + r)))
            block += 4
    earlier = 0
    for q in range(0, symbols, 32):
        # Outputs of levels before the tile's first symbol have no error of it.
        while J[LEVEL_SYMBOL * M + earlier + 1] <= q:
            earlier += 1
        since = max(first, J[LEVEL_OUTPUT * M + earlier])
        p = since
        while p == since or p < count:
            n = min(PANEL, count - p)
            for r in range(begin, end, 4):
                at = read + (r - begin) * outputs + 4 * (p - first)
                add_tile(E, errors + r * stride + q, stride, carried + p * stride + q, n, at, p == since)
            p += PANEL
    rounding += ROUNDING * (outputs + (symbols >> 4) + 16)
    for r in range(begin, end):
        sum_errors(E, X, M, r, errors + r * stride, symbols, rounding)
    return rounding


@njit(cache=True, error_model="numpy")
def pass_errors_on(F, X, J, M, level, begin, end, errors, carried, stride):
    """The table of errors of outputs ``begin:end`` of a level, and a symbol for each that has an error of its own.

    Returns whether all errors are of a size for float32.
    """
    E = as_singles(F)
    known = J[LEVEL_SYMBOL * M + level]
    symbols, fit = known, True
    for p in range(begin, end):
        symbols += X[ERROR * M + J[READ_COLS * M + p]] > 0.0
    J[LEVEL_OUTPUT * M + level + 1] = end
    J[LEVEL_SYMBOL * M + level + 1] = symbols
    zero, symbol = splat_singles(np.float32(0.0)), known
    for p in range(begin, end):
        c, r = J[READ_COLS * M + p], J[READ_ROW * M + p]
        slope = splat_singles(np.float32(X[SLOPE * M + c]))
        source, target = errors + r * stride, carried + p * stride
        for s in range(0, known, 16):
            store(E, target + s, fma(slope, load_singles(E, source + s), zero))
        for s in range((known + 15) & ~15, (symbols + 31) & ~31, 16):
            store(E, target + s, zero)
        error = X[ERROR * M + c]
        growth = abs(X[SLOPE * M + c]) * X[GROWTH * M + r] + error
        fit &= (growth == 0.0) | ((growth > SMALLEST) & (growth < LARGEST))
        if error > 0.0:
            E[target + symbol] = np.float32(error)
            symbol += 1
    return fit


@njit(cache=True, error_model="numpy")
def tracking_floats(rows, cols):
    """Number of float64 that the tables of errors of a system take in scratch."""
    return ((rows + cols) * symbol_stride(cols) + rows * cols) // 2 + 24
