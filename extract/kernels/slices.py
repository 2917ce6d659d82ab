"""Bounds of the output over eight parallel slices of a cell at once, one slice to a lane.

The slices lie between nine planes, equally far apart, on which the output's linear centre is constant. Bounds are those
of `bound` with summed radii, and every slice has relaxations of its own; but where there the lanes hold eight rows,
here they hold eight slices, so that weights are read, and rows looked up, once for all of them.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import (
    fma,
    load_wide,
    magnitude,
    splat_wide,
    store,
)
from mn_onnx.extract.kernels.masks import (
    at_least,
    bits_of,
    both,
    either,
    is_below,
    mask_of,
    same,
)
from mn_onnx.extract.kernels.memory import (
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    knots_of,
    padded,
    weights_of,
)
from mn_onnx.extract.kernels.relax import narrow_states, relax_one_knot, relax_piece_range, with_rounding
from mn_onnx.extract.kernels.slice_points import (
    ABOVE,
    ALL_SLICES,
    COLS,
    DERIVATIVES,
    FORM,
    FORMS,
    OUTPUTS,
    PIECES,
    POINT,
    RANGES,
    REAL_ROWS,
    ROWS,
    SLICES,
    UNDER,
    WEIGHTS,
    value_ranges,
)
from mn_onnx.ir.kernel import kernel


@kernel
def relax_simple(F, K, M, table, rows, r, first, last, low, high):
    """Slopes, offsets and errors of a unit of one knot and one output, from its range in each slice.

    Sets K[ABOVE] and K[UNDER] of its row.
    """
    knot = splat_wide(F[table + r])
    left, left_at = splat_wide(F[table + rows + r]), splat_wide(F[table + 2 * rows + r])
    right, right_at = splat_wide(F[table + 3 * rows + r]), splat_wide(F[table + 4 * rows + r])
    above, under = at_least(low, knot), is_below(high, knot)
    if first == last:
        above, under = mask_of(ALL_SLICES * first), mask_of(ALL_SLICES * (1 - first))
    K[ABOVE * M + r], K[UNDER * M + r] = bits_of(above), bits_of(under)
    return relax_one_knot(knot, left, left_at, right, right_at, low, high, above, under)


@kernel
def relax_tables(N, S, M, tables, row_col, r, unit, first, last, low, high):
    """S[PIECES] of the columns of a unit of any table, from its range in each slice."""
    store(S, RANGES * M, low)
    store(S, RANGES * M + SLICES, high)
    knot = tables.first_knot[unit]
    pieces = tables.first_knot[unit + 1] - knot + 1
    for k in range(SLICES):
        since, until, least, most = narrow_states(
            tables.knots, knot, pieces, first, last, S[RANGES * M + k], S[RANGES * M + SLICES + k]
        )
        piece = tables.first_piece[unit]
        for c in range(N[row_col + r], N[row_col + r + 1]):
            at = PIECES * M + POINT * c + k
            if since == until:
                slope, offset, error = tables.slopes[piece + since], tables.intercepts[piece + since], 0.0
            else:
                slope, offset, error = relax_piece_range(
                    tables.knots, tables.slopes, tables.intercepts, knot, piece, since, until, least, most
                )
            S[at], S[at + SLICES], S[at + 2 * SLICES] = slope, offset, error
            piece += pieces


@kernel
def list_output(S, K, M, rows, r, c, count, c0, c1, c2, c3, growth, slope, offset, error):
    """Append a column's outputs to the list, unless they are zero in all slices; returns its length."""
    zero = splat_wide(0.0)
    if bits_of(both(same(slope, zero), both(same(offset, zero), same(error, zero)))) == ALL_SLICES:
        return count
    K[COLS * M + count], K[ROWS * M + count], K[WEIGHTS * M + count] = c, r, c * rows
    at = OUTPUTS * M + FORM * count
    store(S, at, fma(slope, c0, zero))
    store(S, at + 8, fma(slope, c1, zero))
    store(S, at + 16, fma(slope, c2, zero))
    store(S, at + 24, fma(slope, c3, offset))
    store(S, at + 32, fma(magnitude(slope), growth, error))
    return count + 1


@kernel
def settle_slices(F, N, S, J, K, M, tables, row_unit, row_col, floats, rows, r, count, at):
    """Bound a row, whose form is at S[at], in each slice, and relax its outputs; returns how many are listed."""
    unit = N[row_unit + r]
    c0, c1, c2 = load_wide(S, at), load_wide(S, at + 8), load_wide(S, at + 16)
    c3, growth = load_wide(S, at + 24), load_wide(S, at + 32)
    low, high = value_ranges(S, K, M, c0, c1, c2, c3)
    reach = with_rounding(c0, c1, c2, c3, growth, tables.extent)
    low, high = fma(splat_wide(-1.0), reach, low), fma(splat_wide(1.0), reach, high)
    first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
    table = knots_of(floats, rows)
    if F[table + r] == F[table + r]:
        slope, offset, error = relax_simple(F, K, M, table, rows, r, first, last, low, high)
        c = N[row_col + r]
        at = PIECES * M + POINT * c
        store(S, at, slope)
        store(S, at + 8, offset)
        store(S, at + 16, error)
        return list_output(S, K, M, rows, r, c, count, c0, c1, c2, c3, growth, slope, offset, error)
    K[ABOVE * M + r] = K[UNDER * M + r] = 0
    relax_tables(N, S, M, tables, row_col, r, unit, first, last, low, high)
    for c in range(N[row_col + r], N[row_col + r + 1]):
        at = PIECES * M + POINT * c
        slope, offset, error = load_wide(S, at), load_wide(S, at + 8), load_wide(S, at + 16)
        count = list_output(S, K, M, rows, r, c, count, c0, c1, c2, c3, growth, slope, offset, error)
    return count


@kernel
def read_four(F, S, K, M, floats, rows, r, s, t, u, first, known):
    """S[FORMS]: the affine forms and radii of four rows in each slice, from outputs ``first : known``."""
    at = floats
    a0, b0, c0, d0 = splat_wide(F[at + r]), splat_wide(F[at + s]), splat_wide(F[at + t]), splat_wide(F[at + u])
    at += rows
    a1, b1, c1, d1 = splat_wide(F[at + r]), splat_wide(F[at + s]), splat_wide(F[at + t]), splat_wide(F[at + u])
    at += rows
    a2, b2, c2, d2 = splat_wide(F[at + r]), splat_wide(F[at + s]), splat_wide(F[at + t]), splat_wide(F[at + u])
    at += rows
    a3, b3, c3, d3 = splat_wide(F[at + r]), splat_wide(F[at + s]), splat_wide(F[at + t]), splat_wide(F[at + u])
    a4 = b4 = c4 = d4 = splat_wide(0.0)
    weights = weights_of(floats, rows)
    y = OUTPUTS * M + FORM * first
    for p in range(first, known):
        at = weights + K[WEIGHTS * M + p]
        e, f, g, h = splat_wide(F[at + r]), splat_wide(F[at + s]), splat_wide(F[at + t]), splat_wide(F[at + u])
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
def bound_rows(F, N, S, J, K, M, tables, system, floats):
    """Bound all rows of the system in each slice; returns how many outputs are not zero in all of them."""
    rows, cols, levels = N[system + SYS_ROWS], N[system + SYS_COLS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    row_col = row_unit + rows
    col_end = row_col + rows + 1 + 2 * cols
    first = count = np.int64(0)
    real = REAL_ROWS * M
    for level in range(levels):
        begin, end = N[level_start + level], N[level_start + level + 1]
        while first < count and N[col_end + K[COLS * M + first]] <= begin:
            first += 1
        found = 0
        for r in range(begin, end):
            K[real + found] = r
            found += N[row_unit + r] >= 0
        known = count
        for q in range(0, found, 4):
            last = found - 1 - q
            at = real + q
            r, s, t, u = K[at], K[at + min(1, last)], K[at + min(2, last)], K[at + min(3, last)]
            read_four(F, S, K, M, floats, rows, r, s, t, u, first, known)
            for k in range(min(4, found - q)):
                count = settle_slices(
                    F, N, S, J, K, M, tables, row_unit, row_col, floats, rows, K[at + k], count, FORMS * M + FORM * k
                )
    return count


@kernel
def multiply_columns(F, S, M, weights, columns, begin, end):
    """S[FORMS]: products of the derivatives of rows ``begin : end`` with four columns, given by where they begin."""
    a, b, c, d = splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0)
    for r in range(begin, end):
        m = load_wide(S, DERIVATIVES * M + SLICES * r)
        at = weights + r
        a = fma(splat_wide(F[at + columns[0]]), m, a)
        b = fma(splat_wide(F[at + columns[1]]), m, b)
        c = fma(splat_wide(F[at + columns[2]]), m, c)
        d = fma(splat_wide(F[at + columns[3]]), m, d)
    at = FORMS * M
    store(S, at, a)
    store(S, at + 8, b)
    store(S, at + 16, c)
    store(S, at + 24, d)


@kernel
def pass_back(F, S, K, M, p, out_weights, product, constant, radius):
    """Go on from listed output ``p``, whose product is at S[product], to its row, the constant and the radius."""
    column, row = PIECES * M + POINT * K[COLS * M + p], DERIVATIVES * M + SLICES * K[ROWS * M + p]
    coefficients = fma(splat_wide(1.0), load_wide(S, product), splat_wide(F[out_weights + K[COLS * M + p]]))
    store(S, row, fma(coefficients, load_wide(S, column), load_wide(S, row)))
    constant = fma(coefficients, load_wide(S, column + 8), constant)
    return constant, fma(magnitude(coefficients), load_wide(S, column + 16), radius)


@kernel
def bound_output(F, N, S, K, M, extent, system, floats, count):
    """After `bound_rows`, for every slice the range of the output's centre, and how far the output may be from that."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_begin = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows + rows + 1 + cols
    col_end = col_begin + cols
    weights = weights_of(floats, rows)
    out_weights = weights + cols * rows
    read = WEIGHTS * M
    zero = splat_wide(0.0)
    for r in range(rows):
        store(S, DERIVATIVES * M + SLICES * r, zero)
    constant = radius = zero
    p = count
    while p > 0:
        # Up to four outputs of one level at a time; where there are fewer, the last one again.
        begin = N[col_begin + K[COLS * M + p - 1]]
        width = 1
        while width < 4 and p > width and N[col_begin + K[COLS * M + p - 1 - width]] == begin:
            width += 1
        p -= width
        end = N[col_end + K[COLS * M + p]]
        last = width - 1
        columns = K[read + p], K[read + p + min(1, last)], K[read + p + min(2, last)], K[read + p + last]
        multiply_columns(F, S, M, weights, columns, begin, end)
        for k in range(width):
            constant, radius = pass_back(F, S, K, M, p + k, out_weights, FORMS * M + SLICES * k, constant, radius)
    out = out_weights + padded(cols)
    s0, s1, s2 = splat_wide(F[out]), splat_wide(F[out + 1]), splat_wide(F[out + 2])
    s3 = fma(splat_wide(1.0), constant, splat_wide(F[out + 3]))
    for r in range(rows):
        m = load_wide(S, DERIVATIVES * M + SLICES * r)
        s0 = fma(m, splat_wide(F[floats + r]), s0)
        s1 = fma(m, splat_wide(F[floats + rows + r]), s1)
        s2 = fma(m, splat_wide(F[floats + 2 * rows + r]), s2)
        s3 = fma(m, splat_wide(F[floats + 3 * rows + r]), s3)
    low, high = value_ranges(S, K, M, s0, s1, s2, s3)
    return low, high, with_rounding(s0, s1, s2, s3, radius, extent)


@kernel
def missed_slices(F, N, S, J, K, M, tables, system, floats):
    """The slices that the surface provably misses, as bits, after `place_points`.

    The states of the system's rows over the cell are in J. Sets K[ABOVE] and K[UNDER].
    """
    count = bound_rows(F, N, S, J, K, M, tables, system, floats)
    low, high, slack = bound_output(F, N, S, K, M, tables.extent, system, floats, count)
    below_zero = is_below(high, fma(splat_wide(-1.0), slack, splat_wide(0.0)))
    return bits_of(either(is_below(slack, low), below_zero))


@kernel
def keep_states(N, J, K, M, system, slices):
    """Settle the rows of one knot that are settled alike in all of ``slices``, given as bits; returns how many.

    That is constructive disjunction (Trombettoni and Chabert, Constructive Interval Disjunction, CP 2007).
    """
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    settled = 0
    for r in range(N[system + SYS_ROWS]):
        first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
        if first == last or N[row_unit + r] < 0:
            continue
        if K[ABOVE * M + r] & slices == slices:
            J[STATE_LOW * M + r] = 1
            settled += 1
        elif K[UNDER * M + r] & slices == slices:
            J[STATE_HIGH * M + r] = 0
            settled += 1
    return settled
