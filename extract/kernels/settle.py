"""States of the units of a level that follow from their bounds, and the list of outputs that later levels read.

Eight rows at a time and without branches where all of them have one knot and one output, as almost all units do; which
way such a unit goes is as good as random.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import fma, load_wide, magnitude, splat_wide, store
from mn_onnx.extract.kernels.masks import (
    at_least,
    bits_of,
    both,
    choose,
    count_bits,
    count_up,
    either,
    is_below,
    load_integers,
    multiply,
    pack_store,
    same,
    splat_integer,
    without,
)
from mn_onnx.extract.kernels.memory import (
    COL_KIND,
    DEAD,
    ERROR,
    GROWTH,
    HIGH,
    KIND,
    LINEAR,
    LIVE,
    LIVE_AT,
    LIVE_ROWS,
    LOW,
    OFFSET,
    OUTPUTS,
    RADIUS,
    REACH,
    READ_AT,
    READ_COLS,
    READ_ROW,
    SLOPE,
    STATE_HIGH,
    STATE_LOW,
    UNSTABLE,
    knots_of,
)
from mn_onnx.extract.kernels.relax import relax_one_knot, settle_row, with_rounding
from mn_onnx.ir.kernel import kernel

# Whether rows are settled on a cell for the first time, or again after it has been trimmed.
FIRST, AGAIN = np.bool_(False), np.bool_(True)


@kernel
def enclose_eight(X, M, extent, r, radius):
    """Ranges of rows ``r : r + 8``: X[LOW] and X[HIGH] of their centres, and ``radius`` with what rounding may add.

    A row whose radius is 0 is affine on the cell, and its range is exact.
    """
    zero = splat_wide(0.0)
    c0, c1, c2, c3 = load_wide(X, r), load_wide(X, M + r), load_wide(X, 2 * M + r), load_wide(X, 3 * M + r)
    reach = choose(is_below(zero, radius), with_rounding(c0, c1, c2, c3, radius, extent), zero)
    low = fma(splat_wide(-1.0), reach, load_wide(X, LOW * M + r))
    return low, fma(splat_wide(1.0), reach, load_wide(X, HIGH * M + r))


@kernel
def sides_of_knots(J, M, r, knot, low, high):
    """Where rows ``r : r + 8`` of one knot are above it, or else under it, all over the cell: by state or by range."""
    no, yes = splat_integer(0), splat_integer(1)
    first, last = load_integers(J, STATE_LOW * M + r), load_integers(J, STATE_HIGH * M + r)
    above = either(same(first, yes), both(same(last, yes), at_least(low, knot)))
    return above, without(either(same(last, no), is_below(high, knot)), above)


@kernel
def list_live_rows(F, N, X, J, M, extent, row_unit, floats, rows, begin, end):
    """List the units of ``begin : end`` whose output may be other than zero, with X[REACH] as radii; returns how many.

    J[LIVE_ROWS] are their rows; for every eight rows from ``begin`` on, J[LIVE] has the same as bits, and J[LIVE_AT]
    the place of the first in the list. The radii of all rows become X[REACH]: with these, those not listed settle.
    If the list takes as many eights as the rows do, it is all of them.
    """
    table = knots_of(floats, rows)
    zero, no = splat_wide(0.0), splat_integer(0)
    live = np.int64(0)
    for r in range(begin, end, 8):
        inside = is_below(count_up(r), splat_integer(end))
        knot, left, left_at = (
            load_wide(F, table + r),
            load_wide(F, table + rows + r),
            load_wide(F, table + 2 * rows + r),
        )
        right, right_at = load_wide(F, table + 3 * rows + r), load_wide(F, table + 4 * rows + r)
        reach = load_wide(X, REACH * M + r)
        store(X, RADIUS * M + r, reach)
        low, high = enclose_eight(X, M, extent, r, reach)
        above, under = sides_of_knots(J, M, r, knot, low, high)
        dead_above = both(above, both(same(right, zero), same(right_at, zero)))
        dead_under = both(under, both(same(left, zero), same(left_at, zero)))
        listed = both(inside, at_least(load_integers(N, row_unit + r), no))
        if bits_of(without(inside, same(knot, knot))) == 0:
            listed = without(listed, either(dead_above, dead_under))
        chunk = (r - begin) >> 3
        J[LIVE * M + chunk], J[LIVE_AT * M + chunk] = bits_of(listed), live
        pack_store(J, LIVE_ROWS * M + live, count_up(r), listed)
        live += count_bits(bits_of(listed))
    if (live + 7) >> 3 < (end - begin + 7) >> 3:
        return live
    for r in range(begin, end, 8):
        chunk = (r - begin) >> 3
        J[LIVE * M + chunk], J[LIVE_AT * M + chunk] = 0xFF, r - begin
        store(J, LIVE_ROWS * M + r - begin, count_up(r))
    return end - begin


@kernel
def settle_eight(F, X, J, M, extent, table, rows, r, inside):
    """Settle and relax rows ``r : r + 8`` where ``inside`` holds, all of them of one knot and one output, or padding.

    ``table``: where the system's knots begin in F. Tightens STATE_LOW and STATE_HIGH and sets KIND. Returns slopes,
    offsets and errors, the masks of settled rows and of those whose output is zero, and the kinds.
    """
    zero = splat_wide(0.0)
    no, yes = splat_integer(0), splat_integer(1)
    knot, left, left_at = load_wide(F, table + r), load_wide(F, table + rows + r), load_wide(F, table + 2 * rows + r)
    right, right_at = load_wide(F, table + 3 * rows + r), load_wide(F, table + 4 * rows + r)
    low, high = enclose_eight(X, M, extent, r, load_wide(X, RADIUS * M + r))
    above, under = sides_of_knots(J, M, r, knot, low, high)
    settled = either(above, under)
    slope, offset, error = relax_one_knot(knot, left, left_at, right, right_at, low, high, above, under)
    dead = both(settled, both(same(slope, zero), same(offset, zero)))
    first, last = load_integers(J, STATE_LOW * M + r), load_integers(J, STATE_HIGH * M + r)
    kind = choose(dead, splat_integer(DEAD), choose(settled, splat_integer(LINEAR), splat_integer(UNSTABLE)))
    store(J, STATE_LOW * M + r, choose(inside, choose(above, yes, no), first))
    store(J, STATE_HIGH * M + r, choose(inside, choose(under, no, yes), last))
    store(J, KIND * M + r, kind)
    return slope, offset, error, settled, dead, kind


@kernel
def list_eight(X, J, M, cols, rows, r, slope, offset, error, listed, count):
    """`list_outputs` for the rows of ``r : r + 8`` in the mask ``listed``, whose columns are ``cols``."""
    pack_store(J, READ_COLS * M + count, cols, listed)
    pack_store(J, READ_ROW * M + count, count_up(r), listed)
    pack_store(J, READ_AT * M + count, multiply(cols, splat_integer(rows)), listed)
    zero = splat_wide(0.0)
    growth = fma(magnitude(slope), load_wide(X, GROWTH * M + r), error)
    pack_store(X, OUTPUTS * M + count, fma(slope, load_wide(X, r), zero), listed)
    pack_store(X, (OUTPUTS + 1) * M + count, fma(slope, load_wide(X, M + r), zero), listed)
    pack_store(X, (OUTPUTS + 2) * M + count, fma(slope, load_wide(X, 2 * M + r), zero), listed)
    pack_store(X, (OUTPUTS + 3) * M + count, fma(slope, load_wide(X, 3 * M + r), offset), listed)
    pack_store(X, (OUTPUTS + 4) * M + count, growth, listed)
    return count + count_bits(bits_of(listed))


@kernel
def list_outputs(N, X, J, M, row_col, rows, r, count):
    """Append the relaxed outputs of row ``r`` that are not identically zero to the list that later rows read.

    Entry ``p``: J[READ_COLS] the column, J[READ_ROW] its row, J[READ_AT] where its weights begin, and five numbers, one
    in each region from X[OUTPUTS] on: the affine form and the half width of y. Returns the new length of the list.
    """
    for c in range(N[row_col + r], N[row_col + r + 1]):
        slope, offset, error = X[SLOPE * M + c], X[OFFSET * M + c], X[ERROR * M + c]
        J[READ_COLS * M + count] = c
        J[READ_ROW * M + count] = r
        J[READ_AT * M + count] = c * rows
        at = OUTPUTS * M + count
        X[at] = slope * X[r]
        X[at + M] = slope * X[M + r]
        X[at + 2 * M] = slope * X[2 * M + r]
        X[at + 3 * M] = slope * X[3 * M + r] + offset
        X[at + 4 * M] = abs(slope) * X[GROWTH * M + r] + error
        # The next output takes the place of one that is identically zero.
        count += (slope != 0.0) | (offset != 0.0) | (error != 0.0)
    return count


@kernel
def settle_rows(F, N, X, J, M, tables, row_unit, row_col, floats, rows, begin, end, again, count):
    """Settle and relax rows ``begin : end``; list their outputs from place ``count`` on.

    With ``again``, only rows that were unstable are counted as settled. Returns how many rows have become LINEAR and
    DEAD, and the new length of the list.
    """
    table = knots_of(floats, rows)
    linear, dead = 0, 0
    for r in range(begin, end, 8):
        inside = is_below(count_up(r), splat_integer(end))
        units = load_integers(N, row_unit + r)
        real = both(inside, at_least(units, splat_integer(0)))
        knot = load_wide(F, table + r)
        if bits_of(without(inside, same(knot, knot))) == 0:
            was_unstable = same(load_integers(J, KIND * M + r), splat_integer(UNSTABLE))
            slope, offset, error, settled, zero, kind = settle_eight(F, X, J, M, tables.extent, table, rows, r, inside)
            col = N[row_col + r]
            pack_store(X, SLOPE * M + col, slope, real)
            pack_store(X, OFFSET * M + col, offset, real)
            pack_store(X, ERROR * M + col, error, real)
            pack_store(J, COL_KIND * M + col, kind, real)
            settled = both(settled, real)
            listed = without(real, zero)
            if again:
                settled = both(settled, was_unstable)
            else:
                cols = load_integers(N, row_col + r)
                count = list_eight(X, J, M, cols, rows, r, slope, offset, error, listed, count)
            newly_dead = count_bits(bits_of(both(settled, zero)))
            dead += newly_dead
            linear += count_bits(bits_of(settled)) - newly_dead
            continue
        for q in range(r, min(r + 8, end)):
            unit = N[row_unit + q]
            if unit < 0:
                continue
            # Also rows that were settled before: packing the rows before them has written over their columns.
            counted = not again or J[KIND * M + q] == UNSTABLE
            row_kind = settle_row(N, X, J, M, tables, row_col, q, unit)
            J[KIND * M + q] = row_kind
            for c in range(N[row_col + q], N[row_col + q + 1]):
                J[COL_KIND * M + c] = row_kind
            linear += counted & (row_kind == LINEAR)
            dead += counted & (row_kind == DEAD)
            if not again:
                count = list_outputs(N, X, J, M, row_col, rows, q, count)
    return linear, dead, count
