"""Bounds of the output over eight parallel slices of a cell at once, one slice to a lane.

The slices lie between nine planes, equally far apart, on which the output's linear centre is constant. They are bounded
by what `error_symbols` has found for the whole cell: there a pre-activation is its linear centre plus multiples of
symbols, and a symbol is how far a unit's output is from the unit's chord, in units of the most that is,

    t_i = c_i(x) + sum_j E_ij e_j,    e_j = (y_j(t_j) - s_j t_j - o_j) / m_j.

In a slice, units have shorter chords, y = s' t + o' within m', so that e_j is affine in t_j with slope (s' - s) / m and
error m' / m. Unlike in bounds from weights, a radius does not pass through s', but only through what is new in it, so
that these bounds are nearly as tight as errors tracked anew, and cost the square of the number of undecided units.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.error_symbols import LEAST_SLOPE, TINY
from mn_onnx.extract.kernels.lanes import as_singles, fma, load_wide, magnitude, splat_wide, store
from mn_onnx.extract.kernels.masks import at_least, bits_of, either, is_below, mask_of
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    GROWTH,
    LEVEL_SYMBOL,
    OUTPUT_ROUNDING,
    READ_COLS,
    ROUNDING_SHARE,
    STATE_HIGH,
    STATE_LOW,
    SYMBOL_AT,
    SYMBOL_OFFSET,
    SYMBOL_OUTPUT,
    SYMBOL_RADIUS,
    SYMBOL_ROW,
    SYMBOL_SLOPE,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    knots_of,
)
from mn_onnx.extract.kernels.relax import narrow_states, relax_one_knot, relax_piece_range, with_rounding
from mn_onnx.extract.kernels.slice_points import (
    ABOVE,
    ALL_SLICES,
    FORM,
    FORMS,
    PIECE,
    PIECES,
    RELAXED,
    SLICES,
    SYMBOLS,
    UNDER,
    value_ranges,
)
from mn_onnx.ir.kernel import kernel


@kernel
def relax_simple(F, K, M, table, rows, r, s, first, last, low, high):
    """Slopes, offsets and errors of a unit of one knot and one output, from its range in each slice.

    Sets K[ABOVE] and K[UNDER] of its symbol ``s``.
    """
    knot = splat_wide(F[table + r])
    left, left_at = splat_wide(F[table + rows + r]), splat_wide(F[table + 2 * rows + r])
    right, right_at = splat_wide(F[table + 3 * rows + r]), splat_wide(F[table + 4 * rows + r])
    above, under = at_least(low, knot), is_below(high, knot)
    if first == last:
        above, under = mask_of(ALL_SLICES * first), mask_of(ALL_SLICES * (1 - first))
    K[ABOVE * M + s], K[UNDER * M + s] = bits_of(above), bits_of(under)
    return relax_one_knot(knot, left, left_at, right, right_at, low, high, above, under)


@kernel
def relax_table(S, M, tables, unit, output, first, last, low, high):
    """Slopes, offsets and errors of an output of a unit of any table, from the unit's range in each slice."""
    at = RELAXED * M
    store(S, at, low)
    store(S, at + SLICES, high)
    knot = tables.first_knot[unit]
    pieces = tables.first_knot[unit + 1] - knot + 1
    piece = tables.first_piece[unit] + output * pieces
    for k in range(at, at + SLICES):
        since, until, least, most = narrow_states(tables.knots, knot, pieces, first, last, S[k], S[k + SLICES])
        if since == until:
            slope, offset, error = tables.slopes[piece + since], tables.intercepts[piece + since], 0.0
        else:
            slope, offset, error = relax_piece_range(
                tables.knots, tables.slopes, tables.intercepts, knot, piece, since, until, least, most
            )
        S[k], S[k + SLICES], S[k + 2 * SLICES] = slope, offset, error
    return load_wide(S, at), load_wide(S, at + SLICES), load_wide(S, at + 2 * SLICES)


@kernel
def settle_slices(F, N, X, S, J, K, M, tables, system, floats, s, at):
    """Bound symbol ``s``, the form of whose row is at S[at], in each slice: its form and its pieces.

    An output so flat that all errors of its row are its own (`error_symbols`) has its chord over the row's centre, not
    over the row.
    """
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    r = J[SYMBOL_ROW * M + s]
    c0, c1, c2 = load_wide(S, at), load_wide(S, at + 8), load_wide(S, at + 16)
    c3, radius = load_wide(S, at + 24), load_wide(S, at + 32)
    low, high = value_ranges(S, K, M, c0, c1, c2, c3)
    reach = with_rounding(c0, c1, c2, c3, radius, tables.extent)
    low, high = fma(splat_wide(-1.0), reach, low), fma(splat_wide(1.0), reach, high)
    first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
    table = knots_of(floats, rows)
    if F[table + r] == F[table + r]:
        slope, offset, error = relax_simple(F, K, M, table, rows, r, s, first, last, low, high)
    else:
        K[ABOVE * M + s] = K[UNDER * M + s] = 0
        output = J[READ_COLS * M + J[SYMBOL_OUTPUT * M + s]] - N[row_unit + rows + r]
        slope, offset, error = relax_table(S, M, tables, N[row_unit + r], output, first, last, low, high)
    zero, one = splat_wide(0.0), splat_wide(1.0)
    most, chord = splat_wide(1.0 / X[SYMBOL_RADIUS * M + s]), X[SYMBOL_SLOPE * M + s]
    offset = fma(most, fma(one, offset, splat_wide(-X[SYMBOL_OFFSET * M + s])), zero)
    error = fma(most, error, zero)
    onward, back = fma(one, slope, splat_wide(-chord)), zero
    if abs(chord) < LEAST_SLOPE:
        onward, back = slope, fma(most, splat_wide(-chord), zero)
    onward = fma(most, onward, zero)
    at = PIECES * M + PIECE * s
    store(S, at, onward)
    store(S, at + 8, offset)
    store(S, at + 16, error)
    at = SYMBOLS * M + FORM * s
    store(S, at, fma(onward, c0, fma(back, splat_wide(X[r]), zero)))
    store(S, at + 8, fma(onward, c1, fma(back, splat_wide(X[M + r]), zero)))
    store(S, at + 16, fma(onward, c2, fma(back, splat_wide(X[2 * M + r]), zero)))
    store(S, at + 24, fma(onward, c3, fma(back, splat_wide(X[3 * M + r]), offset)))
    store(S, at + 32, fma(magnitude(onward), radius, error))


@kernel
def begin_form(X, M, r, share):
    """The cell's own affine form of a row, and what rounding of its errors may have taken away."""
    rounding = splat_wide(share * X[GROWTH * M + r] + TINY)
    return splat_wide(X[r]), splat_wide(X[M + r]), splat_wide(X[2 * M + r]), splat_wide(X[3 * M + r]), rounding


@kernel
def read_four(E, X, S, J, M, errors, stride, s, last, known, share):
    """S[FORMS]: the forms and radii in each slice of the rows of symbols ``s .. s + last``, four at most.

    They read the symbols before ``known``. ``errors``, ``stride``: the cell's table; ``share``: its rounding.
    """
    t, u, v = s + min(1, last), s + min(2, last), s + last
    a0, a1, a2, a3, a4 = begin_form(X, M, J[SYMBOL_ROW * M + s], share)
    b0, b1, b2, b3, b4 = begin_form(X, M, J[SYMBOL_ROW * M + t], share)
    c0, c1, c2, c3, c4 = begin_form(X, M, J[SYMBOL_ROW * M + u], share)
    d0, d1, d2, d3, d4 = begin_form(X, M, J[SYMBOL_ROW * M + v], share)
    if known == 0:  # affine, without rounding
        a4 = b4 = c4 = d4 = splat_wide(0.0)
    a, b = errors + J[SYMBOL_AT * M + s] * stride, errors + J[SYMBOL_AT * M + t] * stride
    c, d = errors + J[SYMBOL_AT * M + u] * stride, errors + J[SYMBOL_AT * M + v] * stride
    y = SYMBOLS * M
    for p in range(known):
        e, f = splat_wide(np.float64(E[a + p])), splat_wide(np.float64(E[b + p]))
        g, h = splat_wide(np.float64(E[c + p])), splat_wide(np.float64(E[d + p]))
        y0, y1, y2 = load_wide(S, y), load_wide(S, y + 8), load_wide(S, y + 16)
        y3, y4 = load_wide(S, y + 24), load_wide(S, y + 32)
        a0, b0, c0, d0 = fma(e, y0, a0), fma(f, y0, b0), fma(g, y0, c0), fma(h, y0, d0)
        a1, b1, c1, d1 = fma(e, y1, a1), fma(f, y1, b1), fma(g, y1, c1), fma(h, y1, d1)
        a2, b2, c2, d2 = fma(e, y2, a2), fma(f, y2, b2), fma(g, y2, c2), fma(h, y2, d2)
        a3, b3, c3, d3 = fma(e, y3, a3), fma(f, y3, b3), fma(g, y3, c3), fma(h, y3, d3)
        a4, b4 = fma(magnitude(e), y4, a4), fma(magnitude(f), y4, b4)
        c4, d4 = fma(magnitude(g), y4, c4), fma(magnitude(h), y4, d4)
        y += FORM
    store_form(S, FORMS * M, a0, a1, a2, a3, a4)
    store_form(S, FORMS * M + FORM, b0, b1, b2, b3, b4)
    store_form(S, FORMS * M + 2 * FORM, c0, c1, c2, c3, c4)
    store_form(S, FORMS * M + 3 * FORM, d0, d1, d2, d3, d4)


@kernel
def store_form(S, at, c0, c1, c2, c3, c4):
    """Write five vectors."""
    store(S, at, c0)
    store(S, at + 8, c1)
    store(S, at + 16, c2)
    store(S, at + 24, c3)
    store(S, at + 32, c4)


@kernel
def bound_symbols(F, N, X, S, J, K, M, tables, system, floats, errors, stride):
    """Bound all symbols of the cell in each slice: S[SYMBOLS], S[PIECES], K[ABOVE] and K[UNDER]."""
    E = as_singles(F)
    share = X[CENTRE_AT * M + ROUNDING_SHARE]
    for level in range(N[system + SYS_LEVELS]):
        begin, end = J[LEVEL_SYMBOL * M + level], J[LEVEL_SYMBOL * M + level + 1]
        for s in range(begin, end, 4):
            last = min(3, end - 1 - s)
            read_four(E, X, S, J, M, errors, stride, s, last, begin, share)
            for k in range(last + 1):
                settle_slices(F, N, X, S, J, K, M, tables, system, floats, s + k, FORMS * M + FORM * k)


@kernel
def multiply_rows(E, S, J, M, errors, stride, s, begin, end):
    """S[FORMS]: what the output reads of eight symbols from ``s`` on by way of the rows of symbols ``begin : end``."""
    a, b, c, d = splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0)
    e, f, g, h = splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0)
    for q in range(begin, end):
        m = load_wide(S, PIECES * M + PIECE * q)
        at = errors + J[SYMBOL_AT * M + q] * stride + s
        a, b = fma(splat_wide(np.float64(E[at])), m, a), fma(splat_wide(np.float64(E[at + 1])), m, b)
        c, d = fma(splat_wide(np.float64(E[at + 2])), m, c), fma(splat_wide(np.float64(E[at + 3])), m, d)
        e, f = fma(splat_wide(np.float64(E[at + 4])), m, e), fma(splat_wide(np.float64(E[at + 5])), m, f)
        g, h = fma(splat_wide(np.float64(E[at + 6])), m, g), fma(splat_wide(np.float64(E[at + 7])), m, h)
    at = FORMS * M
    store_form(S, at, a, b, c, d, e)
    store(S, at + 40, f)
    store(S, at + 48, g)
    store(S, at + 56, h)


@kernel
def bound_slice_outputs(F, N, X, S, J, K, M, extent, system, errors, stride, own):
    """After `bound_symbols`, for every slice the range of the output's centre, and how far the output may be from that.

    A backward pass over the slices' chords; ``own``: where the output's row of the table is.
    """
    E = as_singles(F)
    zero, one = splat_wide(0.0), splat_wide(1.0)
    share = X[CENTRE_AT * M + ROUNDING_SHARE]
    levels = N[system + SYS_LEVELS]
    total = J[LEVEL_SYMBOL * M + levels]
    at = CENTRE_AT * M
    s0, s1, s2, s3 = splat_wide(X[at]), splat_wide(X[at + 1]), splat_wide(X[at + 2]), splat_wide(X[at + 3])
    radius = splat_wide(X[at + OUTPUT_ROUNDING])
    for level in range(levels - 1, -1, -1):
        begin, end = J[LEVEL_SYMBOL * M + level], J[LEVEL_SYMBOL * M + level + 1]
        rounding = 0.0 if begin == 0 else 1.0
        for first in range(begin, end, 8):
            multiply_rows(E, S, J, M, errors, stride, first, end, total)
            for s in range(first, min(first + 8, end)):
                r, piece = J[SYMBOL_ROW * M + s], PIECES * M + PIECE * s
                read = load_wide(S, FORMS * M + SLICES * (s - first))
                read = fma(one, read, splat_wide(np.float64(E[own + s])))
                onward = fma(read, load_wide(S, piece), zero)
                store(S, piece, onward)
                s3 = fma(read, load_wide(S, piece + 8), s3)
                radius = fma(magnitude(read), load_wide(S, piece + 16), radius)
                lost = splat_wide(rounding * (share * X[GROWTH * M + r] + TINY))
                radius = fma(magnitude(onward), lost, radius)
                chord = X[SYMBOL_SLOPE * M + s]
                if abs(chord) < LEAST_SLOPE:
                    onward = fma(read, splat_wide(-chord / X[SYMBOL_RADIUS * M + s]), onward)
                s0, s1 = fma(onward, splat_wide(X[r]), s0), fma(onward, splat_wide(X[M + r]), s1)
                s2, s3 = fma(onward, splat_wide(X[2 * M + r]), s2), fma(onward, splat_wide(X[3 * M + r]), s3)
    low, high = value_ranges(S, K, M, s0, s1, s2, s3)
    return low, high, with_rounding(s0, s1, s2, s3, radius, extent)


@kernel
def missed_slices(F, N, X, S, J, K, M, tables, system, floats, errors, stride, own):
    """The slices that the surface provably misses, as bits, after `place_points`.

    The states of the system's rows over the cell are in J. Sets K[ABOVE] and K[UNDER].
    """
    bound_symbols(F, N, X, S, J, K, M, tables, system, floats, errors, stride)
    low, high, slack = bound_slice_outputs(F, N, X, S, J, K, M, tables.extent, system, errors, stride, own)
    below_zero = is_below(high, fma(splat_wide(-1.0), slack, splat_wide(0.0)))
    return bits_of(either(is_below(slack, low), below_zero))


@kernel
def keep_states(N, J, K, M, system, slices):
    """Settle the rows of one knot that are settled alike in all of ``slices``, given as bits; returns how many.

    That is constructive disjunction (Trombettoni and Chabert, Constructive Interval Disjunction, CP 2007).
    """
    settled = 0
    for s in range(J[LEVEL_SYMBOL * M + N[system + SYS_LEVELS]]):
        r = J[SYMBOL_ROW * M + s]
        if J[STATE_LOW * M + r] == J[STATE_HIGH * M + r]:
            continue
        if K[ABOVE * M + s] & slices == slices:
            J[STATE_LOW * M + r] = 1
            settled += 1
        elif K[UNDER * M + s] & slices == slices:
            J[STATE_HIGH * M + r] = 0
            settled += 1
    return settled
