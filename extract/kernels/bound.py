"""Bounds of every unit and of the output over a cell, and the states that follow from them.

Each pre-activation is enclosed by a linear centre and a radius, ``|t - c(x)| <= r``, evaluated at the cell's own
vertices (a linear function is extreme there), and units of several pieces are relaxed (`relax`).
The output is bounded by a backward pass over the same chords, as in CROWN (Zhang et al., NeurIPS 2018).
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.centres import read_outputs, read_tracked_outputs, row_extremes
from mn_onnx.extract.kernels.error_symbols import (
    ROWS_BEYOND,
    clear_row,
    number_errors,
    table_at,
    track_errors,
    track_output,
)
from mn_onnx.extract.kernels.lanes import (
    fma,
    halves,
    lane,
    load,
    load_wide,
    magnitude,
    splat,
    splat_wide,
    store,
    total,
    totals,
)
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CENTRE_AT,
    COL_KIND,
    ERROR,
    GROWTH,
    KIND,
    LEVEL_OUTPUT,
    LEVEL_ROW,
    LEVEL_SYMBOL,
    OFFSET,
    OUT_COEF,
    OUT_VALUES,
    RADIUS,
    READ_COLS,
    SLOPE,
    SYS_COLS,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_SINGLE,
    UNSTABLE,
    padded,
    weights_of,
)
from mn_onnx.extract.kernels.polytope import evaluate_affine, value_range
from mn_onnx.extract.kernels.relax import MARGIN
from mn_onnx.extract.kernels.settle import AGAIN, FIRST, list_live_rows, settle_rows
from mn_onnx.ir.kernel import kernel

# Large cells are bounded no further than a level of whose units less than one in so many settles: of later levels
# still fewer do, and the output could be anything.
LEAST_SETTLED = 4


@kernel
def count_units(N, row_unit, begin, end):
    """How many of the rows are units, and not padding."""
    count = 0
    for r in range(begin, end):
        count += N[row_unit + r] >= 0
    return count


@kernel
def leave_unbounded(N, X, J, M, row_col, rows, begin):
    """Rows from ``begin`` on keep their states, and may be anything."""
    for r in range(begin, rows):
        X[RADIUS * M + r] = np.inf
        J[KIND * M + r] = UNSTABLE
    for c in range(N[row_col + begin], N[row_col + rows]):
        J[COL_KIND * M + c] = UNSTABLE


@kernel
def bound_units(F, N, X, J, M, tables, cell, system, floats, scratch, tracked, large):
    """Forward pass: bounds, states and relaxations of all rows of the system over the cell.

    Reads the row states in J (STATE_LOW, STATE_HIGH) and narrows them, and sets the rows' KIND. If ``tracked``, radii
    come from `error_symbols`, whose table begins at F[scratch]. Returns the numbers of settled rows whose output is not
    identically zero (LINEAR), and whose is (DEAD), whether all levels are bounded: in ``large`` cells not if hardly
    any unit of an earlier one settles; and the radius of the output around the centre in X[CENTRE_AT] if it has been
    tracked, else -1.
    """
    rows, cols, levels = N[system + SYS_ROWS], N[system + SYS_COLS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    row_col = row_unit + rows
    col_end = row_col + rows + 1 + 2 * cols
    weights = weights_of(floats, rows)
    errors, own, stride = table_at(scratch, rows, cols)
    nothing = rows + ROWS_BEYOND + 1  # after the rows of units and the output's, one of zeros
    read = own + 2 * stride
    if tracked:
        clear_row(F, own + stride, stride)
    J[LEVEL_OUTPUT * M] = J[LEVEL_SYMBOL * M] = J[LEVEL_ROW * M] = 0
    first, count, linear, dead = np.int64(0), np.int64(0), 0, 0
    rounding = 0.0
    for level in range(levels):
        begin, end = N[level_start + level], N[level_start + level + 1]
        # The outputs that no later row reads are at the front: extents only grow with the level.
        while first < count and N[col_end + J[READ_COLS * M + first]] <= begin:
            first += 1
        if tracked:
            read_tracked_outputs(F, X, J, M, floats, rows, begin, end, first, count)
        else:
            read_outputs(F, X, J, M, floats, rows, begin, end, first, count)
        row_extremes(F, N, X, M, cell, begin, end)
        if tracked:
            live = list_live_rows(F, N, X, J, M, tables.extent, row_unit, floats, rows, begin, end)
            rounding = track_errors(
                F, X, J, M, weights, begin, end, live, level, first, count, errors, stride, read, rounding
            )
        else:
            for r in range(begin, end, 4):
                store(X, RADIUS * M + r, load(X, GROWTH * M + r))
        before = count
        new_linear, new_dead, count = settle_rows(
            F, N, X, J, M, tables, row_unit, row_col, floats, rows, begin, end, FIRST, count
        )
        linear += new_linear
        dead += new_dead
        if large and level + 1 < levels:
            settled = new_linear + new_dead
            if LEAST_SETTLED * settled < count_units(N, row_unit, begin, end):
                leave_unbounded(N, X, J, M, row_col, rows, end)
                return linear, dead, False, -1.0
        if tracked:
            tracked = number_errors(X, J, M, level, begin, before, count, nothing)
    radius = -1.0
    if tracked:
        out_weights = weights + cols * rows
        constants = out_weights + padded(cols)
        radius = track_output(F, X, J, M, out_weights, constants, levels, count, errors, own, stride, read, rounding)
    return linear, dead, True, radius


@kernel
def bound_first_level(F, N, X, J, M, tables, cell, system, floats):
    """`bound_units` for the first level only, where every row is affine; later rows keep their states."""
    rows, levels = N[system + SYS_ROWS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    end = N[level_start + 1]
    zero = np.int64(0)
    read_outputs(F, X, J, M, floats, rows, zero, end, zero, zero)
    for r in range(end):
        X[RADIUS * M + r] = 0.0
    row_extremes(F, N, X, M, cell, zero, end)
    settle_rows(F, N, X, J, M, tables, row_unit, row_unit + rows, floats, rows, zero, end, FIRST, zero)
    leave_unbounded(N, X, J, M, row_unit + rows, rows, end)


@kernel
def settle_again(F, N, X, J, M, tables, cell, system, floats):
    """After a cell has been trimmed: settle its unstable rows by the centres and radii they had on the whole cell.

    Returns how many rows have become LINEAR, and how many DEAD.
    """
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    row_col = row_unit + rows
    row_extremes(F, N, X, M, cell, np.int64(0), rows)
    zero = np.int64(0)
    linear, dead, _ = settle_rows(F, N, X, J, M, tables, row_unit, row_col, floats, rows, zero, rows, AGAIN, zero)
    return linear, dead


@kernel
def multiply_columns(F, X, multiplier, column, second, third, fourth, begin, end):
    """Products of rows ``begin : end`` of X[multiplier] with four columns, F[column] and those so far behind it."""
    a, b, c, d = splat_wide(0.0), splat_wide(0.0), splat_wide(0.0), splat_wide(0.0)
    q = begin
    while q + 8 <= end:
        m = load_wide(X, multiplier + q)
        at = column + q
        a = fma(m, load_wide(F, at), a)
        b = fma(m, load_wide(F, at + second), b)
        c = fma(m, load_wide(F, at + third), c)
        d = fma(m, load_wide(F, at + fourth), d)
        q += 8
    a4, b4, c4, d4 = halves(a), halves(b), halves(c), halves(d)
    if q < end:
        m = load(X, multiplier + q)
        at = column + q
        a4 = fma(m, load(F, at), a4)
        b4 = fma(m, load(F, at + second), b4)
        c4 = fma(m, load(F, at + third), c4)
        d4 = fma(m, load(F, at + fourth), d4)
    return totals(a4, b4, c4, d4)


@kernel
def bound_output_form(F, N, X, M, system, floats):
    """Backward pass: the output's linear centre (X[CENTRE_AT], four numbers) and its radius, which is returned."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_row = row_col + rows + 1
    col_begin = col_row + cols
    col_end = col_begin + cols
    weights = weights_of(floats, rows)
    out_weights = weights + cols * rows
    multiplier = OUT_COEF * M  # d output / d pre-activation, per row, along the chords
    zero = splat(0.0)
    for r in range(0, rows, 4):
        store(X, multiplier + r, zero)
    one, constants, radii = splat(1.0), zero, zero
    radius, constant = 0.0, 0.0
    c = cols
    while c > 0:
        # Four columns of one level at a time; where there are fewer, the last one again.
        begin = N[col_begin + c - 1]
        width = 1
        while width < 4 and c > width and N[col_begin + c - 1 - width] == begin:
            width += 1
        c -= width
        end = N[col_end + c]
        last = width - 1
        summed = multiply_columns(
            F, X, multiplier, weights + c * rows, min(1, last) * rows, min(2, last) * rows, last * rows, begin, end
        )
        coefficients = fma(one, summed, load(F, out_weights + c))
        onward = fma(coefficients, load(X, SLOPE * M + c), zero)
        if width == 4:
            constants = fma(coefficients, load(X, OFFSET * M + c), constants)
            radii = fma(magnitude(coefficients), load(X, ERROR * M + c), radii)
            row = multiplier + N[col_row + c]
            if N[system + SYS_SINGLE] and N[col_row + c + 3] - N[col_row + c] == 3:  # four rows in a row
                store(X, row, fma(one, onward, load(X, row)))
                continue
        for k in range(width):
            X[multiplier + N[col_row + c + k]] += lane(onward, k)
            if width < 4:
                constant += lane(coefficients, k) * X[OFFSET * M + c + k]
                radius += abs(lane(coefficients, k)) * X[ERROR * M + c + k]
    constant += total(constants)
    radius += total(radii)
    s0, s1, s2, s3 = zero, zero, zero, zero
    for r in range(0, rows, 4):
        m = load(X, multiplier + r)
        s0 = fma(m, load(F, floats + r), s0)
        s1 = fma(m, load(F, floats + rows + r), s1)
        s2 = fma(m, load(F, floats + 2 * rows + r), s2)
        s3 = fma(m, load(F, floats + 3 * rows + r), s3)
    out = out_weights + padded(cols)
    at = CENTRE_AT * M
    X[at] = F[out] + total(s0)
    X[at + 1] = F[out + 1] + total(s1)
    X[at + 2] = F[out + 2] + total(s2)
    X[at + 3] = F[out + 3] + constant + total(s3)
    return radius


@kernel
def bound_output(F, N, X, M, extent, cell, system, floats, radius):
    """The output over the cell, after `bound_units`: the range of its linear centre, and how far it may be from that.

    The centre is in X[CENTRE_AT] (four numbers), its values at the cell's vertices in X[OUT_VALUES].
    """
    if radius < 0.0:
        radius = bound_output_form(F, N, X, M, system, floats)
    at = CENTRE_AT * M
    evaluate_affine(F, N, X, M, cell, OUT_VALUES, X[at], X[at + 1], X[at + 2], X[at + 3])
    low, high = value_range(X, M, OUT_VALUES, N[cell + CELL_CAPACITY])
    size = abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]) + abs(X[at + 3]) + radius
    return low, high, radius + MARGIN * size * extent
