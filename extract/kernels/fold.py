"""Folding: substitute the settled units of a system into the later ones, and leave them out.

A settled unit is affine in its pre-activation, y = s t + o, so its row can be put in its place wherever it is read.
First the settled rows are expressed over the unstable columns (a triangular substitution), then every unstable row
receives the settled rows it reads: a product of two dense matrices, done in blocks of lanes.
"""

from __future__ import annotations

from numba import njit

from mn_onnx.extract.kernels.lanes import fma, load, splat, store
from mn_onnx.extract.kernels.memory import (
    FORMS,
    KEPT_ROWS,
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
    padded,
    system_floats,
    system_ints,
)


@njit(cache=True, error_model="numpy")
def lay_out_folded(N, J, M, system, folded):
    """Write the integer part of the system that keeps the unstable rows only, at ``folded``.

    J[KEPT_ROWS] gives the old row of every new one , repeated where padded, J[NEW_INDEX] the new row of every old one.
    Returns the new numbers of rows and columns.
    """
    rows, levels = N[system + SYS_ROWS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    row_col = row_unit + rows
    new_rows, new_cols, new_levels, new_units = 0, 0, 0, 0
    new_level_start = folded + SYS_HEADER
    N[new_level_start] = 0
    for level in range(levels):
        begin = new_rows
        for r in range(N[level_start + level], N[level_start + level + 1]):
            if N[row_unit + r] >= 0 and J[STATE_LOW * M + r] < J[STATE_HIGH * M + r]:
                J[KEPT_ROWS * M + new_rows] = r
                J[NEW_INDEX * M + r] = new_rows
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
            for _ in range(N[row_col + r], N[row_col + r + 1]):
                N[col_row + c] = q
                N[col_begin + c] = N[new_level_start + level + 1]
                N[col_end + c] = new_rows
                c += 1
    N[new_row_col + new_rows] = c
    return new_rows, new_cols


@njit(cache=True, error_model="numpy")
def list_settled_columns(F, N, X, J, M, system, floats):
    """J[STABLE_COLS]: the columns of settled rows whose output is not identically zero; returns their number."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    col_row = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows + rows + 1
    count = 0
    for c in range(cols):
        r = N[col_row + c]
        if J[STATE_LOW * M + r] == J[STATE_HIGH * M + r] and (X[SLOPE * M + c] != 0.0 or X[OFFSET * M + c] != 0.0):
            J[STABLE_COLS * M + count] = c
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def substitute(F, X, target, length, table, count, coefficients):
    """F[target + k] += sum_p X[coefficients + p] * F[table + p * length + k] for all k < length."""
    k = 0
    while k + 16 <= length:
        a, b = load(F, target + k), load(F, target + k + 4)
        c, d = load(F, target + k + 8), load(F, target + k + 12)
        source = table + k
        for p in range(count):
            w = splat(X[coefficients + p])
            a = fma(w, load(F, source), a)
            b = fma(w, load(F, source + 4), b)
            c = fma(w, load(F, source + 8), c)
            d = fma(w, load(F, source + 12), d)
            source += length
        store(F, target + k, a)
        store(F, target + k + 4, b)
        store(F, target + k + 8, c)
        store(F, target + k + 12, d)
        k += 16
    while k < length:
        a = load(F, target + k)
        source = table + k
        for p in range(count):
            a = fma(splat(X[coefficients + p]), load(F, source), a)
            source += length
        store(F, target + k, a)
        k += 4


@njit(cache=True, error_model="numpy")
def express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, folded, work, stride):
    """Every settled column's output over the unstable columns and the input.

    Row ``p`` of the table at ``F[work]``, ``stride`` apart: weights on the new columns, then (padded) the four affine
    coefficients.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_row = row_col + rows + 1
    col_begin = col_row + cols
    new_rows = N[folded + SYS_ROWS]
    new_col_row = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + 2 * new_rows + 1
    new_row_col = new_col_row - new_rows - 1
    weights = floats + 4 * rows
    affine = padded(new_cols)
    for p in range(settled):
        c = J[STABLE_COLS * M + p]
        r = N[col_row + c]
        slope = X[SLOPE * M + c]
        at = work + p * stride
        for k in range(0, stride, 4):
            store(F, at + k, splat(0.0))
        if slope == 0.0:
            F[at + affine + 3] = X[OFFSET * M + c]
            continue
        for k in range(new_cols):
            q = N[new_col_row + k]
            old = N[row_col + J[KEPT_ROWS * M + q]] + k - N[new_row_col + q]
            if N[col_begin + old] > r:
                break
            F[at + k] = F[weights + old * rows + r]
        for axis in range(4):
            F[at + affine + axis] = F[floats + axis * rows + r]
        readers = 0
        for e in range(p):
            earlier = J[STABLE_COLS * M + e]
            reads = N[col_begin + earlier] <= r
            X[FORMS * M + e] = F[weights + earlier * rows + r] if reads else 0.0
            readers = e + 1 if reads else readers
        substitute(F, X, at, stride, work, readers, FORMS * M)
        factor = splat(slope)
        zero = splat(0.0)
        for k in range(0, stride, 4):
            store(F, at + k, fma(factor, load(F, at + k), zero))
        F[at + affine + 3] += X[OFFSET * M + c]


@njit(cache=True, error_model="numpy")
def gather_column(F, J, M, source, begin, rows, target):
    """Copy a column's weights on the kept rows ``begin:rows``."""
    kept = KEPT_ROWS * M
    for q in range(begin, rows):
        F[target + q] = F[source + J[kept + q]]


@njit(cache=True, error_model="numpy")
def accumulate(F, target, begin, rows, gathered, first, count, coefficients, stride):
    """F[target + q] += sum_p F[coefficients + p * stride] * F[gathered + p * rows + q].

    Over rows ``begin <= q < rows`` and settled columns ``first <= p < count``.
    """
    q = begin
    while q + 16 <= rows:
        a, b = load(F, target + q), load(F, target + q + 4)
        c, d = load(F, target + q + 8), load(F, target + q + 12)
        source = gathered + first * rows + q
        for p in range(first, count):
            w = splat(F[coefficients + p * stride])
            a = fma(w, load(F, source), a)
            b = fma(w, load(F, source + 4), b)
            c = fma(w, load(F, source + 8), c)
            d = fma(w, load(F, source + 12), d)
            source += rows
        store(F, target + q, a)
        store(F, target + q + 4, b)
        store(F, target + q + 8, c)
        store(F, target + q + 12, d)
        q += 16
    while q < rows:
        a = load(F, target + q)
        source = gathered + first * rows + q
        for p in range(first, count):
            a = fma(splat(F[coefficients + p * stride]), load(F, source), a)
            source += rows
        store(F, target + q, a)
        q += 4


@njit(cache=True, error_model="numpy")
def fold(F, N, X, J, M, system, floats, folded, folded_floats):
    """Write the folded system at ``folded`` (N) and ``folded_floats`` (F); scratch follows it in F.

    Needs the states in J and the relaxations in X of `bound_units`. `folding_floats` tells how much of F is used.
    """
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_begin = row_col + rows + 1 + cols
    col_end = col_begin + cols
    new_rows, new_cols = lay_out_folded(N, J, M, system, folded)
    settled = list_settled_columns(F, N, X, J, M, system, floats)
    new_row_col = folded + SYS_HEADER + N[folded + SYS_LEVELS] + 1 + new_rows
    new_col_row = new_row_col + new_rows + 1
    stride = padded(new_cols) + 4
    affine = padded(new_cols)
    work = folded_floats + N[folded + SYS_FLOATS]
    gathered = work + settled * stride
    express_settled_rows(F, N, X, J, M, system, floats, settled, new_cols, folded, work, stride)
    weights = floats + 4 * rows
    begin = 0
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
        gather_column(F, J, M, floats + axis * rows, 0, new_rows, target)
        accumulate(F, target, 0, new_rows, gathered, 0, settled, work + affine + axis, stride)
    new_weights = folded_floats + 4 * new_rows
    new_out = new_weights + new_cols * new_rows
    out_weights = weights + cols * rows
    new_col_begin = new_col_row + new_cols
    col_row = row_col + rows + 1
    first = 0
    for k in range(new_cols):
        q = N[new_col_row + k]
        old = N[row_col + J[KEPT_ROWS * M + q]] + k - N[new_row_col + q]
        while first < settled and N[col_row + J[STABLE_COLS * M + first]] <= N[col_row + old]:
            first += 1
        target = new_weights + k * new_rows
        gather_column(F, J, M, weights + old * rows, N[new_col_begin + k], new_rows, target)
        accumulate(F, target, N[new_col_begin + k], new_rows, gathered, first, settled, work + k, stride)
        F[new_out + k] = F[out_weights + old]
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
def carry_states(N, J, M, tables, system, folded):
    """After `fold`: move the state ranges in J to the rows of the folded system and hash the settled states into it."""
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    hash0, hash1 = N[system + SYS_HASH], N[system + SYS_HASH + 1]
    for r in range(rows):
        unit = N[row_unit + r]
        if unit >= 0 and J[STATE_LOW * M + r] == J[STATE_HIGH * M + r]:
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
    return system_floats(rows, cols) + cols * (padded(cols) + 4) + cols * rows
