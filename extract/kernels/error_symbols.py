"""Radii from every unit's own error, as in zonotopes: errors that reach a row along several ways may cancel.

A radius summed level by level grows with the product of the layers' absolute weights: after eight layers it can be a
hundred times what this gives. The same forms are in Singh et al., Fast and Effective Robustness Certification (NeurIPS
2018). The error of an unstable unit is a *symbol*, a value in [-1, 1]; every row has a coefficient for each symbol
before it, and its radius is the sum of their magnitudes. The cost is the cube of the number of units, so this is for
deep systems only, and not for every cell.

A row's coefficients are, for the symbols of outputs that it reads, their errors times its weights, and what the rows of
these outputs have for the symbols before them, times weights and slopes. So the table has rows of pre-activations only.
The network's output is one more row: that is what a backward pass over the same chords gives. Units whose output is
proved to be zero before, from the radii of the outputs that they read, need no row: a third of all in wide layers.

The table is float32, and the radius is enlarged by the most that its rounding can have taken away: the magnitudes
of all that is summed add up to no more than X[GROWTH], so n roundings in a row take at most n halves of a unit in the
last place of that (Higham, Accuracy and Stability of Numerical Algorithms, section 3.1).
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import (
    as_singles,
    fma,
    load_eight,
    load_singles,
    load_wide,
    magnitude,
    round_to_singles,
    splat_eight,
    splat_singles,
    splat_wide,
    store,
    store_transposed,
    times,
    total,
)
from mn_onnx.extract.kernels.masks import count_bits, mask_of, pack
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    ERROR,
    GROWTH,
    LEVEL_OUTPUT,
    LEVEL_ROW,
    LEVEL_SYMBOL,
    LIVE,
    LIVE_AT,
    LIVE_ROWS,
    OFFSET,
    OUT_COEF,
    OUTPUT_ROUNDING,
    OUTPUTS,
    RADIUS,
    READ_AT,
    READ_COLS,
    READ_RADIUS,
    READ_ROW,
    READ_SLOPE,
    READ_SYMBOL,
    ROUNDING_SHARE,
    SLOPE,
    SYMBOL_AT,
    SYMBOL_ERROR,
    SYMBOL_OFFSET,
    SYMBOL_OUTPUT,
    SYMBOL_RADIUS,
    SYMBOL_ROW,
    SYMBOL_SLOPE,
    aligned,
    symbol_stride,
)
from mn_onnx.extract.kernels.relax import MARGIN
from mn_onnx.ir.kernel import kernel

# Half a unit in the last place of float32, and a little for products of several such errors.
ROUNDING = 1.05 * 2.0**-24
# Errors are tracked as long as all of them add up to numbers in this range: there float32 is far from both its ends.
SMALLEST, LARGEST = 2.0**-40, 2.0**40
# What float32 can lose of a radius at its lower end: 2^-149 times LARGEST / LEAST_SLOPE for a symbol.
TINY = 2.0**-80
# Errors of a row go on through its outputs by slopes of at least this size, else as one new error of the output.
LEAST_SLOPE = 2.0**-10
# Rows are begun eight at a time: so many after the last are written to as well.
ROWS_BEYOND = 8
# So many rows of a tile stay in the nearest cache.
PANEL = 192


@kernel
def add_tile(E, J, target, stride, table, read, count, weights, room, first):
    """Add 16 symbols of what eight rows read of ``count`` rows before them to E[target], or write them if ``first``.

    ``table``: the first symbol's entry of row 0; ``read``: J's index of the rows read; ``weights``: eight for each,
    ``room`` apart.
    """
    t1, t2, t3 = target + stride, target + 2 * stride, target + 3 * stride
    t4, t5, t6, t7 = target + 4 * stride, t1 + 4 * stride, t2 + 4 * stride, t3 + 4 * stride
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = splat_singles(np.float32(0.0))
    if not first:
        a0, a1, a2, a3 = load_singles(E, target), load_singles(E, t1), load_singles(E, t2), load_singles(E, t3)
        a4, a5, a6, a7 = load_singles(E, t4), load_singles(E, t5), load_singles(E, t6), load_singles(E, t7)
    for p in range(count):
        u = load_singles(E, table + J[read + p] * stride)
        a0 = fma(splat_singles(E[weights]), u, a0)
        a1 = fma(splat_singles(E[weights + 1]), u, a1)
        a2 = fma(splat_singles(E[weights + 2]), u, a2)
        a3 = fma(splat_singles(E[weights + 3]), u, a3)
        a4 = fma(splat_singles(E[weights + 4]), u, a4)
        a5 = fma(splat_singles(E[weights + 5]), u, a5)
        a6 = fma(splat_singles(E[weights + 6]), u, a6)
        a7 = fma(splat_singles(E[weights + 7]), u, a7)
        weights += room
    store(E, target, a0)
    store(E, t1, a1)
    store(E, t2, a2)
    store(E, t3, a3)
    store(E, t4, a4)
    store(E, t5, a5)
    store(E, t6, a6)
    store(E, t7, a7)


@kernel
def clear_row(F, row, stride):
    """Write zeros to a row of the table."""
    E = as_singles(F)
    for q in range(row, row + stride, 16):
        store(E, q, splat_singles(np.float32(0.0)))


@kernel
def gather_weights(F, E, X, J, M, weights, begin, end, live, first, count, read, room):
    """Weights times X[READ_SLOPE] of the ``live`` rows of ``begin:end`` on the outputs ``first:count``.

    At E[read], ``room`` numbers for each output.
    """
    zero = splat_wide(0.0)
    for p in range(first, count):
        column, slope = weights + J[READ_AT * M + p] + begin, splat_wide(X[READ_SLOPE * M + p])
        if live == end - begin:
            for r in range(0, live, 8):
                store(E, read + r, round_to_singles(fma(load_wide(F, column + r), slope, zero)))
        else:
            for chunk in range((end - begin + 7) >> 3):
                weight = pack(load_wide(F, column + 8 * chunk), mask_of(J[LIVE * M + chunk]))
                store(E, read + J[LIVE_AT * M + chunk], round_to_singles(fma(weight, slope, zero)))
        read += room


@kernel
def begin_rows(E, X, J, M, live, known, symbols, errors, stride, read, room):
    """What so many rows of the table from E[errors] on read of the own errors ``known:symbols``.

    Zeros fill the tiles in which these begin and end; those before are left to `add_tile`. ``read``: what
    `gather_weights` has written, from output 0 on.
    """
    nothing = splat_singles(np.float32(0.0))
    for row in range(errors, errors + live * stride, stride):
        store(E, row + (known & ~15), nothing)
        store(E, row + (symbols & ~15), nothing)
    for s in range(known, symbols, 4):
        at, own = SYMBOL_OUTPUT * M + s, SYMBOL_ERROR * M + s
        a, b = read + J[at] * room, read + J[at + 1] * room
        c, d = read + J[at + 2] * room, read + J[at + 3] * room
        e, f = splat_eight(np.float32(X[own])), splat_eight(np.float32(X[own + 1]))
        g, h = splat_eight(np.float32(X[own + 2])), splat_eight(np.float32(X[own + 3]))
        target = errors + s
        for r in range(0, live, 8):
            store_transposed(
                E,
                target,
                stride,
                times(load_eight(E, a + r), e),
                times(load_eight(E, b + r), f),
                times(load_eight(E, c + r), g),
                times(load_eight(E, d + r), h),
            )
            target += 8 * stride


@kernel
def summed_errors(E, target, symbols, growth, rounding):
    """The sum of a row's errors' magnitudes, with their rounding: at most ``growth``."""
    one, summed = splat_singles(np.float32(1.0)), splat_singles(np.float32(0.0))
    for s in range(0, symbols, 16):
        summed = fma(one, magnitude(load_singles(E, target + s)), summed)
    radius = total(summed) + (rounding + MARGIN) * growth + TINY
    return radius if radius < growth else growth


@kernel
def track_errors(F, X, J, M, weights, begin, end, live, level, first, count, errors, stride, read, rounding):
    """Radii of the ``live`` rows of ``begin:end``, those of a level, from the error of every single unit before.

    ``weights``: F's index of the columns. ``first:count``: the outputs that the rows read. In F as float32, the table
    of errors starts at ``errors``, ``stride`` numbers for each live row; ``read`` is scratch of a number for each row
    and output. ``rounding``: how many roundings a number of the table may have had, as a share of X[GROWTH]; returns
    the same with these rows.
    """
    E = as_singles(F)
    symbols, outputs = J[LEVEL_SYMBOL * M + level], count - first
    known = J[READ_SYMBOL * M + first] if first < count else symbols
    own_rows = errors + J[LEVEL_ROW * M + level] * stride
    J[LEVEL_ROW * M + level + 1] = J[LEVEL_ROW * M + level] + live
    room = (live + 15) & ~7
    gather_weights(F, E, X, J, M, weights, begin, end, live, first, count, read, room)
    begin_rows(E, X, J, M, live, known, symbols, own_rows, stride, read - first * room, room)
    earlier = 0
    for q in range(0, symbols, 16):
        # Errors of the tile's first level reach rows of later levels only.
        while J[LEVEL_SYMBOL * M + earlier + 1] <= q:
            earlier += 1
        p = max(first, J[LEVEL_OUTPUT * M + earlier + 1])
        is_first = q + 16 <= known
        while p < count or is_first:
            n = min(PANEL, count - p)
            for r in range(0, live, 8):
                at = read + (p - first) * room + r
                target = own_rows + r * stride + q
                add_tile(E, J, target, stride, errors + q, READ_ROW * M + p, n, at, room, is_first)
            p += PANEL
            is_first = False
    rounding += ROUNDING * (outputs + (symbols >> 4) + 16)
    for r in range(live):
        row = J[LIVE_ROWS * M + r]
        X[RADIUS * M + row] = summed_errors(E, own_rows + r * stride, symbols, X[GROWTH * M + row], rounding)
    return rounding


@kernel
def number_errors(X, J, M, level, level_begin, begin, end, nothing):
    """A symbol for each of the outputs ``begin:end`` of a level that has an error of its own.

    J[READ_ROW] of the outputs becomes their row of the table; ``nothing``: one of zeros;
    ``level_begin``: the level's first row. For `slices`, a symbol keeps its row (J[SYMBOL_ROW]), that of the table
    (J[SYMBOL_AT]), and the output's chord and error (X[SYMBOL_SLOPE], X[SYMBOL_OFFSET], X[SYMBOL_RADIUS]). Returns
    whether all errors are of a size for float32.
    """
    symbols, fit = J[LEVEL_SYMBOL * M + level], True
    for p in range(begin, end):
        c, row = J[READ_COLS * M + p], J[READ_ROW * M + p]
        chunk, before = (row - level_begin) >> 3, (1 << ((row - level_begin) & 7)) - 1
        place = J[LIVE_AT * M + chunk] + count_bits(J[LIVE * M + chunk] & before)
        J[READ_ROW * M + p] = J[LEVEL_ROW * M + level] + place
        slope, error = X[SLOPE * M + c], X[ERROR * M + c]
        X[READ_RADIUS * M + p] = abs(slope) * X[RADIUS * M + row] + error
        J[SYMBOL_ROW * M + symbols], J[SYMBOL_AT * M + symbols] = row, J[READ_ROW * M + p]
        X[SYMBOL_SLOPE * M + symbols], X[SYMBOL_OFFSET * M + symbols] = slope, X[OFFSET * M + c]
        if abs(slope) < LEAST_SLOPE:
            # All errors of so flat an output are its own.
            slope, error = 1.0, X[READ_RADIUS * M + p]
            J[READ_ROW * M + p] = nothing
        X[SYMBOL_RADIUS * M + symbols] = error
        X[READ_SLOPE * M + p] = slope
        J[READ_SYMBOL * M + p] = symbols
        J[SYMBOL_OUTPUT * M + symbols] = p
        X[SYMBOL_ERROR * M + symbols] = error / slope
        symbols += error > 0.0
        growth = X[(OUTPUTS + 4) * M + p]
        fit &= (growth == 0.0) | ((growth > SMALLEST) & (growth < LARGEST))
        fit &= X[GROWTH * M + row] < LARGEST
    for s in range(symbols, symbols + 4):  # read, but of no output
        X[SYMBOL_ERROR * M + s] = 0.0
        J[SYMBOL_OUTPUT * M + s] = end - 1
    J[LEVEL_OUTPUT * M + level + 1] = end
    J[LEVEL_SYMBOL * M + level + 1] = symbols
    return fit


@kernel
def add_four(E, J, target, symbols, errors, stride, read, count, weights):
    """Add ``symbols`` errors of four rows, or of ``count`` if that is less, weighted, to E[target].

    ``errors``: the table; ``read``: J's index of the rows.
    """
    none = np.float32(0.0)
    last = count - 1
    s0, s1 = errors + J[read] * stride, errors + J[read + min(1, last)] * stride
    s2, s3 = errors + J[read + min(2, last)] * stride, errors + J[read + last] * stride
    w0, w1 = splat_singles(E[weights]), splat_singles(E[weights + 1] if count > 1 else none)
    w2 = splat_singles(E[weights + 2] if count > 2 else none)
    w3 = splat_singles(E[weights + 3] if count > 3 else none)
    for q in range(0, symbols, 16):
        a = fma(w0, load_singles(E, s0 + q), load_singles(E, target + q))
        a = fma(w1, load_singles(E, s1 + q), a)
        a = fma(w2, load_singles(E, s2 + q), a)
        a = fma(w3, load_singles(E, s3 + q), a)
        store(E, target + q, a)


@kernel
def centre_output(F, X, J, M, out_weights, constants, count):
    """The output's linear centre over ``count`` outputs of units, X[CENTRE_AT] (four numbers); returns its growth.

    ``out_weights``: F's index of the columns' weights in the output; ``constants``: of its affine part. Leaves the
    weights of the outputs in X[OUT_COEF].
    """
    for p in range(count):
        X[OUT_COEF * M + p] = F[out_weights + J[READ_COLS * M + p]]
    c0, c1, c2, c3, growth = splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0)
    for p in range(0, count - 7, 8):
        weight, y = load_wide(X, OUT_COEF * M + p), OUTPUTS * M + p
        c0 = fma(weight, load_wide(X, y), c0)
        c1 = fma(weight, load_wide(X, y + M), c1)
        c2 = fma(weight, load_wide(X, y + 2 * M), c2)
        c3 = fma(weight, load_wide(X, y + 3 * M), c3)
        growth = fma(magnitude(weight), load_wide(X, y + 4 * M), growth)
    at = CENTRE_AT * M
    X[at], X[at + 1] = F[constants] + total(c0), F[constants + 1] + total(c1)
    X[at + 2], X[at + 3] = F[constants + 2] + total(c2), F[constants + 3] + total(c3)
    most = total(growth)
    for p in range(count & ~7, count):
        weight, y = X[OUT_COEF * M + p], OUTPUTS * M + p
        for k in range(4):
            X[at + k] += weight * X[y + k * M]
        most += abs(weight) * X[y + 4 * M]
    return most


@kernel
def track_output(F, X, J, M, out_weights, constants, levels, count, errors, own, stride, read, rounding):
    """The output's linear centre (X[CENTRE_AT], four numbers) and its radius, which is returned.

    After all ``levels``; ``own``: where its row of the table goes, ``stride`` numbers. What rounding may have taken off
    errors is left in X[CENTRE_AT] too. The others as for `track_errors` and `centre_output`.
    """
    E = as_singles(F)
    growth = centre_output(F, X, J, M, out_weights, constants, count)
    symbols = J[LEVEL_SYMBOL * M + levels]
    for q in range(symbols & ~15, symbols, 16):
        store(E, own + q, splat_singles(np.float32(0.0)))
    for p in range(count):
        # What an output without an error of its own writes, the next one that has one writes over.
        weight, symbol = X[OUT_COEF * M + p], J[READ_SYMBOL * M + p]
        weight *= X[READ_SLOPE * M + p]
        E[read + p] = np.float32(weight)
        E[own + symbol] = np.float32(weight * X[SYMBOL_ERROR * M + symbol])
    for level in range(1, levels):
        known = J[LEVEL_SYMBOL * M + level]
        end = J[LEVEL_OUTPUT * M + level + 1]
        for p in range(J[LEVEL_OUTPUT * M + level], end, 4):
            add_four(E, J, own, known, errors, stride, READ_ROW * M + p, min(4, end - p), read + p)
    rounding += ROUNDING * (count + (symbols >> 4) + 16)
    X[CENTRE_AT * M + ROUNDING_SHARE] = rounding + MARGIN
    X[CENTRE_AT * M + OUTPUT_ROUNDING] = (rounding + MARGIN) * growth + TINY
    return summed_errors(E, own, symbols, growth, rounding)


@kernel
def table_at(scratch, rows, cols):
    """Where the table of errors of a system is if F's scratch begins at ``scratch``: counted in float32.

    Returns the places of its first row and of the output's row, and from one row to the next.
    """
    stride = symbol_stride(cols)
    errors = 2 * aligned(scratch)
    return errors, errors + (rows + ROWS_BEYOND) * stride, stride


@kernel
def tracking_floats(rows, cols):
    """Number of float64 that the table of errors of a system takes in scratch."""
    return (rows + ROWS_BEYOND + 2) * symbol_stride(cols) // 2 + (rows + 24) * cols // 2 + 24
