"""Bounds of the output over eight parallel slices of a cell at once, one slice to a lane.

The slices lie between nine planes, equally far apart, on which the output's linear centre is constant. They are bounded
by what `error_symbols` has found for the whole cell: there a pre-activation is its linear centre plus multiples of
symbols, and a symbol is how far a unit's output is from the unit's chord, in units of the most that is,

    t_i = c_i(x) + sum_j E_ij e_j,    e_j = (y_j(t_j) - s_j t_j - o_j) / m_j.

In a slice, units have shorter chords, y = s' t + o' within m', so that e_j is affine in t_j with slope (s' - s) / m and
error m' / m. Unlike in bounds from weights, a radius does not pass through s', but only through what is new in it, so
that these bounds are nearly as tight as errors tracked anew, and cost the square of the number of undecided units.

Symbols are summed in float32, as forms around the cell's middle, where none is much larger than one; what rounding may
take away of a row is then at most half a unit in the last place of the row's radius for every symbol, and a little.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.error_symbols import LEAST_SLOPE, ROUNDING, TINY
from mn_onnx.extract.kernels.lanes import (
    as_doubles,
    as_singles,
    fma,
    larger,
    load_eight,
    load_wide,
    magnitude,
    round_to_singles,
    splat_eight,
    splat_wide,
    store,
)
from mn_onnx.extract.kernels.masks import at_least, bits_of, either, is_below, mask_of
from mn_onnx.extract.kernels.memory import (
    CENTRE_AT,
    GROWTH,
    LEVEL_SYMBOL,
    OUTPUT_ROUNDING,
    RADIUS,
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
    DERIVATIVES,
    FORM,
    FORMS,
    MIDDLE,
    MOST,
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
    """Bound symbol ``s``, the form of whose row is at S[at], in each slice: its form and its chord.

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
    c0 = fma(onward, c0, fma(back, splat_wide(X[r]), zero))
    c1 = fma(onward, c1, fma(back, splat_wide(X[M + r]), zero))
    c2 = fma(onward, c2, fma(back, splat_wide(X[2 * M + r]), zero))
    c3 = fma(onward, c3, fma(back, splat_wide(X[3 * M + r]), offset))
    store_symbol(S, M, s, c0, c1, c2, c3, fma(magnitude(onward), radius, error))


@kernel
def store_symbol(S, M, s, c0, c1, c2, c3, radius):
    """Write a symbol's form and radius, around the cell's middle, to S[SYMBOLS], and enlarge S[MOST] if need be."""
    T, one = as_singles(S), splat_wide(1.0)
    middle = MIDDLE * M
    x, y, z = splat_wide(S[middle]), splat_wide(S[middle + 1]), splat_wide(S[middle + 2])
    value = fma(c0, x, fma(c1, y, fma(c2, z, c3)))
    at = 2 * SYMBOLS * M + FORM * s
    store(T, at, round_to_singles(c0))
    store(T, at + 8, round_to_singles(c1))
    store(T, at + 16, round_to_singles(c2))
    store(T, at + 24, round_to_singles(value))
    store(T, at + 32, round_to_singles(radius))
    x, y, z = splat_wide(S[middle + 3]), splat_wide(S[middle + 4]), splat_wide(S[middle + 5])
    most = fma(one, magnitude(value), radius)
    most = fma(magnitude(c0), x, fma(magnitude(c1), y, fma(magnitude(c2), z, most)))
    store(S, middle + MOST, larger(most, load_wide(S, middle + MOST)))


@kernel
def finish_form(X, S, M, r, known, share, at, c0, c1, c2, c3, radius):
    """S[at]: a row's form and radius, its own centre and what it reads of ``known`` symbols, given in float32.

    ``share``: the rounding of the cell's table.
    """
    one, minus, middle = splat_wide(1.0), splat_wide(-1.0), MIDDLE * M
    d0, d1, d2, d3 = as_doubles(c0), as_doubles(c1), as_doubles(c2), as_doubles(c3)
    store(S, at, fma(one, d0, splat_wide(X[r])))
    store(S, at + 8, fma(one, d1, splat_wide(X[M + r])))
    store(S, at + 16, fma(one, d2, splat_wide(X[2 * M + r])))
    at_middle = fma(d0, splat_wide(S[middle]), fma(d1, splat_wide(S[middle + 1]), splat_wide(0.0)))
    at_middle = fma(d2, splat_wide(S[middle + 2]), at_middle)
    store(S, at + 24, fma(minus, at_middle, fma(one, d3, splat_wide(X[3 * M + r]))))
    if known == 0:  # affine, without rounding
        store(S, at + 32, splat_wide(0.0))
        return
    lost = splat_wide(ROUNDING * (known + 8) * X[RADIUS * M + r])
    lost = fma(lost, load_wide(S, middle + MOST), splat_wide(share * X[GROWTH * M + r] + TINY))
    store(S, at + 32, fma(one, as_doubles(radius), lost))


@kernel
def read_four(E, X, S, J, M, errors, stride, s, last, known, share):
    """S[FORMS]: the forms and radii in each slice of the rows of symbols ``s .. s + last``, four at most.

    They read the symbols before ``known``. ``errors``, ``stride``: the cell's table; ``share``: its rounding.
    """
    T = as_singles(S)
    t, u, v = s + min(1, last), s + min(2, last), s + last
    a0 = a1 = a2 = a3 = a4 = b0 = b1 = b2 = b3 = b4 = splat_eight(np.float32(0.0))
    c0 = c1 = c2 = c3 = c4 = d0 = d1 = d2 = d3 = d4 = a0
    a, b = errors + J[SYMBOL_AT * M + s] * stride, errors + J[SYMBOL_AT * M + t] * stride
    c, d = errors + J[SYMBOL_AT * M + u] * stride, errors + J[SYMBOL_AT * M + v] * stride
    y = 2 * SYMBOLS * M
    for p in range(known):
        e, f, g, h = splat_eight(E[a + p]), splat_eight(E[b + p]), splat_eight(E[c + p]), splat_eight(E[d + p])
        y0, y1, y2 = load_eight(T, y), load_eight(T, y + 8), load_eight(T, y + 16)
        y3, y4 = load_eight(T, y + 24), load_eight(T, y + 32)
        a0, b0, c0, d0 = fma(e, y0, a0), fma(f, y0, b0), fma(g, y0, c0), fma(h, y0, d0)
        a1, b1, c1, d1 = fma(e, y1, a1), fma(f, y1, b1), fma(g, y1, c1), fma(h, y1, d1)
        a2, b2, c2, d2 = fma(e, y2, a2), fma(f, y2, b2), fma(g, y2, c2), fma(h, y2, d2)
        a3, b3, c3, d3 = fma(e, y3, a3), fma(f, y3, b3), fma(g, y3, c3), fma(h, y3, d3)
        a4, b4 = fma(magnitude(e), y4, a4), fma(magnitude(f), y4, b4)
        c4, d4 = fma(magnitude(g), y4, c4), fma(magnitude(h), y4, d4)
        y += FORM
    at, rows = FORMS * M, SYMBOL_ROW * M
    finish_form(X, S, M, J[rows + s], known, share, at, a0, a1, a2, a3, a4)
    finish_form(X, S, M, J[rows + t], known, share, at + FORM, b0, b1, b2, b3, b4)
    finish_form(X, S, M, J[rows + u], known, share, at + 2 * FORM, c0, c1, c2, c3, c4)
    finish_form(X, S, M, J[rows + v], known, share, at + 3 * FORM, d0, d1, d2, d3, d4)


@kernel
def bound_symbols(F, N, X, S, J, K, M, tables, system, floats, errors, stride):
    """Bound all symbols of the cell in each slice: S[SYMBOLS], S[PIECES], K[ABOVE] and K[UNDER]."""
    E = as_singles(F)
    share = X[CENTRE_AT * M + ROUNDING_SHARE]
    store(S, MIDDLE * M + MOST, splat_wide(1.0))
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
    T = as_singles(S)
    a = b = c = d = e = f = g = h = splat_eight(np.float32(0.0))
    for q in range(begin, end):
        m = load_eight(T, 2 * DERIVATIVES * M + SLICES * q)
        at = errors + J[SYMBOL_AT * M + q] * stride + s
        a, b = fma(splat_eight(E[at]), m, a), fma(splat_eight(E[at + 1]), m, b)
        c, d = fma(splat_eight(E[at + 2]), m, c), fma(splat_eight(E[at + 3]), m, d)
        e, f = fma(splat_eight(E[at + 4]), m, e), fma(splat_eight(E[at + 5]), m, f)
        g, h = fma(splat_eight(E[at + 6]), m, g), fma(splat_eight(E[at + 7]), m, h)
    at = FORMS * M
    store(S, at, as_doubles(a))
    store(S, at + 8, as_doubles(b))
    store(S, at + 16, as_doubles(c))
    store(S, at + 24, as_doubles(d))
    store(S, at + 32, as_doubles(e))
    store(S, at + 40, as_doubles(f))
    store(S, at + 48, as_doubles(g))
    store(S, at + 56, as_doubles(h))


@kernel
def bound_slice_outputs(F, N, X, S, J, K, M, extent, system, errors, stride, own):
    """After `bound_symbols`, for every slice the range of the output's centre, and how far the output may be from that.

    A backward pass over the slices' chords; ``own``: where the output's row of the table is. No symbol is larger than
    one, so that what rounding takes off their coefficients adds up to no more than it can be off radii.
    """
    E, T = as_singles(F), as_singles(S)
    zero, one = splat_wide(0.0), splat_wide(1.0)
    share = X[CENTRE_AT * M + ROUNDING_SHARE]
    levels = N[system + SYS_LEVELS]
    total = J[LEVEL_SYMBOL * M + levels]
    unit_roundoff = ROUNDING * (total + 8)
    at = CENTRE_AT * M
    s0, s1, s2, s3 = splat_wide(X[at]), splat_wide(X[at + 1]), splat_wide(X[at + 2]), splat_wide(X[at + 3])
    radius = splat_wide(X[at + OUTPUT_ROUNDING])
    for level in range(levels - 1, -1, -1):
        begin, end = J[LEVEL_SYMBOL * M + level], J[LEVEL_SYMBOL * M + level + 1]
        rounded = 0.0 if begin == 0 else 1.0
        for first in range(begin, end, 8):
            multiply_rows(E, S, J, M, errors, stride, first, end, total)
            for s in range(first, min(first + 8, end)):
                r, piece = J[SYMBOL_ROW * M + s], PIECES * M + PIECE * s
                read = load_wide(S, FORMS * M + SLICES * (s - first))
                read = fma(one, read, splat_wide(np.float64(E[own + s])))
                onward = fma(read, load_wide(S, piece), zero)
                store(T, 2 * DERIVATIVES * M + SLICES * s, round_to_singles(onward))
                s3 = fma(read, load_wide(S, piece + 8), s3)
                radius = fma(magnitude(read), load_wide(S, piece + 16), radius)
                lost = rounded * (share * X[GROWTH * M + r] + TINY) + unit_roundoff * X[RADIUS * M + r]
                radius = fma(magnitude(onward), splat_wide(lost), radius)
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
