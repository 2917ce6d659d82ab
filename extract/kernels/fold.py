"""Folding: substitute the settled units of a system into the later ones, and leave them out.

A settled unit whose output is zero is simply left out. Any other settled unit is affine in its pre-activation,
y = s t + o, so its row can be put in its place wherever it is read. First the settled rows are expressed over the kept
columns (a triangular substitution, level by level), then every kept row receives the settled rows it reads: products
of dense matrices, in register tiles.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mn_onnx.extract.kernels.lanes import splat, store
from mn_onnx.extract.kernels.memory import (
    KEPT_ROWS,
    KIND,
    NEW_INDEX,
    OFFSET,
    SLOPE,
    STABLE_COLS,
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_FLOATS,
    SYS_HASH,
    SYS_HEADER,
    SYS_INTS,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_UNITS,
    UNSTABLE,
    padded,
    system_floats,
    system_ints,
)
from mn_onnx.extract.kernels.products import accumulate, accumulate_four


@njit(cache=True, error_model="numpy")
def lay_out_folded(N, J, M, system, folded, least):
    """Write the integer part of the system that keeps the rows of kind ``least`` or more, at ``folded``.

    J[KEPT_ROWS] gives the old row of every new one, repeated where padded, J[NEW_INDEX] the new row of every old one
    (of one that is left out: of the next). Returns the new numbers of rows and columns.
    """
    rows, levels = N[system + SYS_ROWS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    row_col = row_unit + rows
    new_rows, new_cols, new_levels, new_units = np.int64(0), np.int64(0), np.int64(0), 0
    new_level_start = folded + SYS_HEADER
    N[new_level_start] = 0
    for level in range(levels):
        begin = new_rows
        for r in range(N[level_start + level], N[level_start + level + 1]):
            J[NEW_INDEX * M + r] = new_rows
            if N[row_unit + r] >= 0 and J[KIND * M + r] >= least:
                J[KEPT_ROWS * M + new_rows] = r
                new_rows += 1
                new_units += 1
                new_cols += N[row_col + r + 1] - N[row_col + r]
        if new_rows > begin:
            while new_rows & 3:
                # Padding repeats a row: finite, and read by nothing.
                J[KEPT_ROWS * M + new_rows] = J[KEPT_ROWS * M + new_rows - 1]
                new_rows += 1
            new_levels += 1
            N[new_level_start + new_levels] = new_rows
    N[folded + SYS_ROWS] = new_rows
    N[folded + SYS_COLS] = new_cols
    N[folded + SYS_LEVELS] = new_levels
    N[folded + SYS_FLOATS] = system_floats(new_rows, new_cols)
    N[folded + SYS_INTS] = system_ints(new_rows, new_cols, new_levels)
    N[folded + SYS_UNITS] = new_units
    new_unit = new_level_start + new_levels + 1
    new_row_col = new_unit + new_rows
    col_row = new_row_col + new_rows + 1
    col_begin = col_row + new_cols
    col_end = col_begin + new_cols
    old_col_end = row_col + rows + 1 + 2 * N[system + SYS_COLS]
    c = 0
    level = 0
    for q in range(new_rows):
        if q == N[new_level_start + level + 1]:
            level += 1
        N[new_row_col + q] = c
        r = J[KEPT_ROWS * M + q]
        real = q == 0 or r != J[KEPT_ROWS * M + q - 1]
        N[new_unit + q] = N[row_unit + r] if real else -1
        if real:
            for old in range(N[row_col + r], N[row_col + r + 1]):
                N[col_row + c] = q
                N[col_begin + c] = N[new_level_start + level + 1]
                end = N[old_col_end + old]
                if least == UNSTABLE or end == rows:
                    N[col_end + c] = new_rows  # substitution fills the column
                else:
                    N[col_end + c] = max(padded(J[NEW_INDEX * M + end]), N[col_begin + c])
                c += 1
    N[new_row_col + new_rows] = c
    return new_rows, new_cols


@njit(cache=True, error_model="numpy")
def list_settled_columns(N, X, J, M, system, least):
    """J[STABLE_COLS]: the columns, not identically zero, of rows of a kind below ``least``; returns their number."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_row = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows + rows + 1
    count = 0
    for c in range(cols):
        r = N[col_row + c]
        if J[KIND * M + r] < least and (X[SLOPE * M + c] != 0.0 or X[OFFSET * M + c] != 0.0):
            J[STABLE_COLS * M + count] = c
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def read_settled_row(F, N, X, J, M, system, floats, p, new_cols, folded, at, stride):
    """What settled column ``p`` reads of the kept columns and the input, times its slope: F[at : at + stride]."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_row = row_col + rows + 1
    col_begin = col_row + cols
    new_rows = N[folded + SYS_ROWS]
    new_row_col = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + new_rows
    new_col_row = new_row_col + new_rows + 1
    weights = floats + 4 * rows
    affine = padded(new_cols)
    c = J[STABLE_COLS * M + p]
    r = N[col_row + c]
    slope = X[SLOPE * M + c]
    for k in range(0, stride, 4):
        store(F, at + k, splat(0.0))
    for k in range(new_cols):
        q = N[new_col_row + k]
        old = N[row_col + J[KEPT_ROWS * M + q]] + k - N[new_row_col + q]
        if N[col_begin + old] > r:
            break
        F[at + k] = slope * F[weights + old * rows + r]
    for axis in range(4):
        F[at + affine + axis] = slope * F[floats + axis * rows + r]
    F[at + affine + 3] += X[OFFSET * M + c]


@njit(cache=True, error_model="numpy")
def express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, folded, work, stride, scratch):
    """Every settled column's output over the kept columns and the input.

    Row ``p`` of the table at ``F[work]``, ``stride`` apart: weights on the new columns, then (padded) the four affine
    coefficients. Level by level: those of one level read only settled columns of earlier ones, all in one product.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_row = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + 2 * rows + 1
    col_begin = col_row + cols
    weights = floats + 4 * rows
    zero = first = np.int64(0)
    while first < settled:
        level_end = N[col_begin + J[STABLE_COLS * M + first]]
        last = first
        while last < settled and N[col_begin + J[STABLE_COLS * M + last]] == level_end:
            read_settled_row(F, N, X, J, M, system, floats, last, new_cols, folded, work + last * stride, stride)
            last += 1
        width = last - first
        for e in range(first):
            source = weights + J[STABLE_COLS * M + e] * rows
            target = scratch + e * width - first
            for p in range(first, last):
                c = J[STABLE_COLS * M + p]
                F[target + p] = X[SLOPE * M + c] * F[source + N[col_row + c]]
        p = first
        while p + 4 <= last:
            accumulate_four(F, work + p * stride, zero, stride, stride, work, zero, first, scratch + p - first, width)
            p += 4
        while p < last:
            accumulate(F, work + p * stride, zero, stride, stride, work, zero, first, scratch + p - first, width)
            p += 1
        first = last


@njit(cache=True, error_model="numpy")
def gather_column(F, J, M, source, begin, rows, target):
    """Copy a column's weights on the kept rows ``begin:rows``."""
    kept = KEPT_ROWS * M
    for q in range(begin, rows):
        F[target + q] = F[source + J[kept + q]]


@njit(cache=True, error_model="numpy")
def multiply_settled(F, N, J, M, folded, weights, gathered, settled, work, stride, col_row):
    """Add to every kept column what the rows read of it through the settled ones, four columns of a level at a time."""
    rows, cols = N[folded + SYS_ROWS], N[folded + SYS_COLS]
    new_col_row = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + 2 * rows + 1
    col_begin = new_col_row + cols
    first, k = np.int64(0), 0
    while k < cols:
        # Settled units of this column's level or before do not read it.
        row = J[KEPT_ROWS * M + N[new_col_row + k]]
        while first < settled and N[col_row + J[STABLE_COLS * M + first]] <= row:
            first += 1
        begin = N[col_begin + k]
        if k + 4 <= cols and N[col_begin + k + 3] == begin:
            accumulate_four(F, weights + k * rows, begin, rows, rows, gathered, first, settled, work + k, stride)
            k += 4
        else:
            accumulate(F, weights + k * rows, begin, rows, rows, gathered, first, settled, work + k, stride)
            k += 1


@njit(cache=True, error_model="numpy")
def fold(F, N, X, J, M, system, floats, folded, folded_floats, least):
    """Write the folded system at ``folded`` (N) and ``folded_floats`` (F); scratch follows it in F.

    ``least`` is UNSTABLE to substitute all settled rows, LINEAR to leave out the dead ones only. Needs the kinds
    and relaxations of `bound_units`. `folding_floats` tells how much of F is used.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_begin = row_col + rows + 1 + cols
    new_rows, new_cols = lay_out_folded(N, J, M, system, folded, least)
    settled = list_settled_columns(N, X, J, M, system, least)
    new_row_col = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + new_rows
    new_col_row = new_row_col + new_rows + 1
    stride = padded(new_cols) + 4
    affine = padded(new_cols)
    work = folded_floats + N[folded + SYS_FLOATS]
    gathered = work + settled * stride
    express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, folded, work, stride, gathered)
    weights = floats + 4 * rows
    zero = begin = np.int64(0)
    for p in range(settled):
        c = J[STABLE_COLS * M + p]
        # Later rows only: a settled column is read by no row of its own level or before.
        while begin < new_rows and J[KEPT_ROWS * M + begin] < N[col_begin + c]:
            begin += 1
        gather_column(F, J, M, weights + c * rows, begin, new_rows, gathered + p * new_rows)
        for q in range(begin):
            F[gathered + p * new_rows + q] = 0.0
    for axis in range(4):
        target = folded_floats + axis * new_rows
        gather_column(F, J, M, floats + axis * rows, zero, new_rows, target)
    accumulate_four(F, folded_floats, zero, new_rows, new_rows, gathered, zero, settled, work + affine, stride)
    new_weights = folded_floats + 4 * new_rows
    new_out = new_weights + new_cols * new_rows
    out_weights = weights + cols * rows
    new_col_begin = new_col_row + new_cols
    col_row = row_col + rows + 1
    for k in range(new_cols):
        q = N[new_col_row + k]
        old = N[row_col + J[KEPT_ROWS * M + q]] + k - N[new_row_col + q]
        gather_column(F, J, M, weights + old * rows, N[new_col_begin + k], new_rows, new_weights + k * new_rows)
        F[new_out + k] = F[out_weights + old]
    multiply_settled(F, N, J, M, folded, new_weights, gathered, settled, work, stride, col_row)
    out, new_constant = out_weights + padded(cols), new_out + padded(new_cols)
    for axis in range(4):
        F[new_constant + axis] = F[out + axis]
    for p in range(settled):
        w = F[out_weights + J[STABLE_COLS * M + p]]
        at = work + p * stride
        for k in range(new_cols):
            F[new_out + k] += w * F[at + k]
        for axis in range(4):
            F[new_constant + axis] += w * F[at + affine + axis]


@njit(cache=True, error_model="numpy")
def carry_states(N, J, M, tables, system, folded, least):
    """After `fold`: move the state ranges in J to the rows of the folded system, hash the others' states into it."""
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    hash0, hash1 = N[system + SYS_HASH], N[system + SYS_HASH + 1]
    for r in range(rows):
        unit = N[row_unit + r]
        if unit >= 0 and J[KIND * M + r] < least:
            state = tables.first_knot[unit] + unit + J[STATE_LOW * M + r]
            hash0 ^= tables.state_hash[2 * state]
            hash1 ^= tables.state_hash[2 * state + 1]
    N[folded + SYS_HASH], N[folded + SYS_HASH + 1] = hash0, hash1
    for q in range(N[folded + SYS_ROWS]):
        r = J[KEPT_ROWS * M + q]
        J[STATE_LOW * M + q] = J[STATE_LOW * M + r]
        J[STATE_HIGH * M + q] = J[STATE_HIGH * M + r]


@njit(cache=True, error_model="numpy")
def folding_floats(rows, cols):
    """Upper bound of what `fold` writes to F for a system of this size."""
    return system_floats(rows, cols) + cols * (padded(cols) + 4) + cols * max(rows, cols)
