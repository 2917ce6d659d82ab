"""Folding: substitute the settled units of a system into the later ones, and leave them out.

A settled unit whose output is zero is simply left out. Any other settled unit is affine in its pre-activation,
y = s t + o, so its row can be put in its place wherever it is read. First the settled rows are expressed over the kept
columns (a triangular substitution, level by level), then every kept row receives the settled rows it reads: products
of dense matrices, in register tiles.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import fma, lanes_of, load_wide, splat, splat_wide, store
from mn_onnx.extract.kernels.layout import lay_out_folded, new_row
from mn_onnx.extract.kernels.masks import (
    bits_of,
    both,
    count_bits,
    count_up,
    is_below,
    load_integers,
    mask_of,
    pack_store,
    same,
    splat_integer,
    without,
)
from mn_onnx.extract.kernels.memory import (
    COL_KIND,
    KEPT,
    KEPT_ROWS,
    OFFSET,
    OLD_COL,
    PLACE,
    ROW_FLOATS,
    SETTLED_ROW,
    SETTLED_SLOPE,
    SINCE,
    SLOPE,
    STABLE_COLS,
    SYS_COLS,
    SYS_FLOATS,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    UNSTABLE,
    UNTIL,
    aligned,
    padded,
    system_floats,
    weights_of,
)
from mn_onnx.extract.kernels.products import TILE, accumulate
from mn_onnx.ir.kernel import kernel

# `gather_column` writes up to so many numbers after the last one.
OVERWRITTEN = 8
# So many columns are written at a time; see `write_columns`.
COLUMN_BLOCK = 8
FOUR = np.int64(4)  # of numpy's, see `memory`


@kernel
def list_settled_columns(N, X, J, M, system, least):
    """The columns, not identically zero, of rows of a kind below ``least``; returns their number.

    J[STABLE_COLS], J[SETTLED_ROW], X[SETTLED_SLOPE]: the columns, their rows and slopes.
    """
    if least < UNSTABLE:
        return np.int64(0)  # only rows whose output is zero are left out
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_row = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows + rows + 1
    count = np.int64(0)
    zero = splat_wide(0.0)
    for c in range(0, cols, 8):
        slope, offset = load_wide(X, SLOPE * M + c), load_wide(X, OFFSET * M + c)
        kind = load_integers(J, COL_KIND * M + c)
        is_zero = both(same(slope, zero), same(offset, zero))
        inside = is_below(count_up(c), splat_integer(cols))
        settled = without(both(inside, is_below(kind, splat_integer(least))), is_zero)
        pack_store(J, STABLE_COLS * M + count, count_up(c), settled)
        pack_store(J, SETTLED_ROW * M + count, load_integers(N, col_row + c), settled)
        pack_store(X, SETTLED_SLOPE * M + count, slope, settled)
        count += count_bits(bits_of(settled))
    return count


@kernel
def read_settled_rows(F, N, X, J, M, system, floats, first, last, new_cols, work, stride):
    """What settled columns ``first : last``, of one level, read of the kept columns and the input, times their slope.

    For each, F[work + p * stride] and on: the four affine coefficients, then the new columns, padded. Returns how many
    of these numbers are not zero for want of anything to read; after them come zeros for the length of a tile.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_begin = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + 2 * rows + 1 + cols
    col_end = col_begin + cols
    weights = weights_of(floats, rows)
    level_begin = J[SETTLED_ROW * M + first]
    zero = splat(0.0)
    # Columns of this level and later ones are not read, nor those that end before.
    read = unread = 0
    while read < new_cols and N[col_begin + J[OLD_COL * M + read]] <= level_begin:
        read += 1
    while unread < read and N[col_end + J[OLD_COL * M + unread]] <= level_begin:
        unread += 1
    for p in range(first, last):
        for k in range(0, unread, 4):
            store(F, work + p * stride + 4 + k, zero)
    for k in range(unread, read, 4):
        a, b = weights + J[OLD_COL * M + k] * rows, weights + J[OLD_COL * M + min(k + 1, read - 1)] * rows
        c, d = (
            weights + J[OLD_COL * M + min(k + 2, read - 1)] * rows,
            weights + J[OLD_COL * M + min(k + 3, read - 1)] * rows,
        )
        for p in range(first, last):
            r = J[SETTLED_ROW * M + p]
            slope = splat(X[SETTLED_SLOPE * M + p])
            store(F, work + p * stride + 4 + k, fma(slope, lanes_of(F[a + r], F[b + r], F[c + r], F[d + r]), zero))
    for p in range(first, last):
        r, slope, at = J[SETTLED_ROW * M + p], X[SETTLED_SLOPE * M + p], work + p * stride
        for axis in range(4):
            F[at + axis] = slope * F[floats + axis * rows + r]
        F[at + 3] += X[OFFSET * M + J[STABLE_COLS * M + p]]
        J[SINCE * M + p], J[UNTIL * M + p] = 0, 4 + padded(read)
        for k in range(4 + padded(read), min(stride, 4 + padded(read) + TILE), 4):
            store(F, at + k, zero)
        for k in range(4 + read, 4 + padded(read)):
            F[at + k] = 0.0
    return 4 + padded(read)


@kernel
def express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, work, stride, scratch):
    """Every settled column's output over the kept columns and the input.

    Row ``p`` of the table at ``F[work]``, ``stride`` apart: the four affine coefficients, then the weights on the new
    columns. Level by level: those of one level read only settled columns of earlier ones, all in one product.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_begin = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + 2 * rows + 1 + cols
    col_end = col_begin + cols
    weights = weights_of(floats, rows)
    zero = first = read = np.int64(0)
    while first < settled:
        level_end = N[col_begin + J[STABLE_COLS * M + first]]
        last = first
        while last < settled and J[SETTLED_ROW * M + last] < level_end:
            last += 1
        used = read_settled_rows(F, N, X, J, M, system, floats, first, last, new_cols, work, stride)
        width = last - first
        # Outputs that no row of this level reads are at the front.
        while read < first and N[col_end + J[STABLE_COLS * M + read]] <= J[SETTLED_ROW * M + first]:
            read += 1
        for e in range(read, first):
            source = weights + J[STABLE_COLS * M + e] * rows
            target = scratch + e * width - first
            for p in range(first, last):
                F[target + p] = X[SETTLED_SLOPE * M + p] * F[source + J[SETTLED_ROW * M + p]]
        accumulate(F, J, M, work + first * stride, width, zero, used, stride, work, read, first, scratch, width)
        first = last


@kernel
def gather_column(F, J, M, source, begin, end, target):
    """Copy what the old rows ``begin : end`` have of a column to their new rows.

    What follows it is overwritten, see OVERWRITTEN.
    """
    for chunk in range(begin >> 3, (end + 7) >> 3):
        weights = load_wide(F, source + 8 * chunk)
        pack_store(F, target + J[PLACE * M + chunk], weights, mask_of(J[KEPT * M + chunk]))


@kernel
def gather_settled(F, N, J, M, system, floats, settled, new_rows, gathered):
    """What the kept rows read of every settled column, ``new_rows`` numbers each from F[gathered] on.

    With J[SINCE] and J[UNTIL], and zeros before and after, for `accumulate`.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_begin = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + 2 * rows + 1 + cols
    col_end = col_begin + cols
    weights = weights_of(floats, rows)
    begin = end = np.int64(0)
    for p in range(settled):
        c = J[STABLE_COLS * M + p]
        old_end = N[col_end + c]
        # Later rows only: a settled column is read by no row of its own level or before.
        while begin < new_rows and J[KEPT_ROWS * M + begin] < N[col_begin + c]:
            begin += 1
        while end < new_rows and J[KEPT_ROWS * M + end] < old_end:
            end += 1
        gather_column(F, J, M, weights + c * rows, N[col_begin + c], old_end, gathered + p * new_rows)
        for q in range(max(begin - TILE, 0), begin, 4):
            store(F, gathered + p * new_rows + q, splat(0.0))
        until = padded(end)
        for q in range(end, min(until + TILE, new_rows), 4):
            store(F, gathered + p * new_rows + q, splat(0.0))
        J[SINCE * M + p], J[UNTIL * M + p] = begin, until


@kernel
def write_columns(F, N, J, M, system, floats, folded, weights, gathered, settled, work, stride):
    """Write the folded system's columns: the kept ones, and what the rows read of them through the settled ones.

    A block of columns at a time, which is still in the nearer caches when it is added to. All columns of a level have
    the same extents.
    """
    old_rows, old_cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    old_begin = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + 2 * old_rows + 1 + old_cols
    old_end = old_begin + old_cols
    old_weights = weights_of(floats, old_rows)
    rows, cols = N[folded + SYS_ROWS], N[folded + SYS_COLS]
    col_begin = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + 2 * rows + 1 + cols
    col_end = col_begin + cols
    zero = splat(0.0)
    first = k = np.int64(0)
    while k < cols:
        # Settled units of this column's level or before do not read it.
        level_end = N[old_begin + J[OLD_COL * M + k]]
        while first < settled and J[SETTLED_ROW * M + first] < level_end:
            first += 1
        begin, end = N[col_begin + k], N[col_end + k]
        since, until = N[old_begin + J[OLD_COL * M + k]], N[old_end + J[OLD_COL * M + k]]
        reached = new_row(J, M, until) if until < old_rows else rows
        last = k
        while last < cols and last < k + COLUMN_BLOCK and N[col_begin + last] == begin:
            source, target = old_weights + J[OLD_COL * M + last] * old_rows, weights + last * rows
            gather_column(F, J, M, source, since, until, target)
            for q in range(max(reached, begin), end, 4):
                store(F, target + q, zero)
            last += 1
        accumulate(F, J, M, weights + k * rows, last - k, begin, end, rows, gathered, first, settled, work + k, stride)
        k = last


@kernel
def fold(F, N, X, J, M, system, floats, folded, folded_floats, least):
    """Write the folded system at ``folded`` (N) and ``folded_floats`` (F); scratch follows it in F.

    ``least`` is UNSTABLE to substitute all settled rows, LINEAR to leave out the dead ones only. Needs the kinds
    and relaxations of `bound_units`. `folding_floats` tells how much of F is used.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_begin = row_col + rows + 1 + cols
    settled = list_settled_columns(N, X, J, M, system, least)
    new_rows, new_cols = lay_out_folded(N, J, M, system, folded, least, settled)
    stride = aligned(new_cols + 4)
    work = aligned(folded_floats + N[folded + SYS_FLOATS] + OVERWRITTEN)
    gathered = work + settled * stride
    express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, work, stride, gathered)
    weights = weights_of(floats, rows)
    out_weights = weights + cols * rows
    new_weights = weights_of(folded_floats, new_rows)
    new_out = new_weights + new_cols * new_rows
    gather_settled(F, N, J, M, system, floats, settled, new_rows, gathered)
    zero = np.int64(0)
    for k in range(ROW_FLOATS):
        gather_column(F, J, M, floats + k * rows, zero, rows, folded_floats + k * new_rows)
    accumulate(F, J, M, folded_floats, FOUR, zero, new_rows, new_rows, gathered, zero, settled, work, stride)
    write_columns(F, N, J, M, system, floats, folded, new_weights, gathered, settled, work + 4, stride)
    for k in range(new_cols):
        F[new_out + k] = F[out_weights + J[OLD_COL * M + k]]
    out, new_constant = out_weights + padded(cols), new_out + padded(new_cols)
    for axis in range(4):
        F[new_constant + axis] = F[out + axis]
    read = 0  # how many columns are of earlier levels
    for p in range(settled):
        while read < new_cols and N[col_begin + J[OLD_COL * M + read]] <= J[SETTLED_ROW * M + p]:
            read += 1
        w = F[out_weights + J[STABLE_COLS * M + p]]
        at = work + p * stride
        for k in range(read):
            F[new_out + k] += w * F[at + 4 + k]
        for axis in range(4):
            F[new_constant + axis] += w * F[at + axis]


@kernel
def folding_floats(rows, cols):
    """Upper bound of what `fold` writes to F for a system of this size."""
    return system_floats(rows, cols) + cols * aligned(cols + 4) + cols * max(rows, cols) + 4 * OVERWRITTEN
