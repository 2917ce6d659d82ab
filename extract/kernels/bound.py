"""Bounds of every unit and of the output over a cell, and the states that follow from them.

Each pre-activation is enclosed by a linear centre and a radius, ``|t - c(x)| <= r``, evaluated at the cell's own
vertices (a linear function is extreme there). A unit of several pieces is relaxed by its chord over the range of ``t``.
The output is bounded by a backward pass over the same chords, as in CROWN (Zhang et al., NeurIPS 2018).
"""

from __future__ import annotations

from numba import njit

from mn_onnx.extract.kernels.lanes import fma, lane, larger, load, magnitude, smaller, splat, store
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_FLOATS,
    CELL_VERTICES,
    CENTRE_AT,
    DEAD,
    ERROR,
    HIGH,
    KIND,
    LINEAR,
    LOW,
    OFFSET,
    OUT_COEF,
    OUTPUTS,
    RADIUS,
    READ_AT,
    READ_COLS,
    SLOPE,
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    UNSTABLE,
    padded,
)

# Rounding of a bound, relative to the magnitude of what was summed: 2^-40 is about 4000 units in the last place.
MARGIN = 2.0**-40


@njit(cache=True, error_model="numpy")
def row_extremes(F, N, X, M, cell, begin, end):
    """LOW and HIGH of rows ``begin:end`` (multiples of the lane width) over the cell's vertices."""
    n = N[cell + CELL_VERTICES]
    x = N[cell + CELL_FLOATS]
    capacity = N[cell + CELL_CAPACITY]
    y, z = x + capacity, x + 2 * capacity
    for r in range(begin, end, 4):
        c0, c1, c2, c3 = load(X, r), load(X, M + r), load(X, 2 * M + r), load(X, 3 * M + r)
        low = fma(c0, splat(F[x]), fma(c1, splat(F[y]), fma(c2, splat(F[z]), c3)))
        high = low
        for v in range(1, n):
            value = fma(c0, splat(F[x + v]), fma(c1, splat(F[y + v]), fma(c2, splat(F[z + v]), c3)))
            low = smaller(value, low)
            high = larger(value, high)
        store(X, LOW * M + r, low)
        store(X, HIGH * M + r, high)


@njit(cache=True, error_model="numpy")
def relax_piece_range(knots, slopes, intercepts, knot, piece, first, last, low, high):
    """Relax a table's pieces ``first..last``, more than one, by their chord over [low, high].

    Returns slope, offset and error with ``|y - slope t - offset| <= error``.
    """
    at_low = slopes[piece + first] * low + intercepts[piece + first]
    at_high = slopes[piece + last] * high + intercepts[piece + last]
    slope = (at_high - at_low) / (high - low)
    above, below = 0.0, 0.0
    for s in range(first, last):
        kappa = knots[knot + s]
        deviation = slopes[piece + s] * kappa + intercepts[piece + s] - (at_low + slope * (kappa - low))
        above = max(above, deviation)
        below = min(below, deviation)
    return slope, at_low - slope * low + 0.5 * (above + below), 0.5 * (above - below)


@njit(cache=True, error_model="numpy")
def settle_row(N, X, J, M, tables, cols, r, unit):
    """Tighten the state range of row ``r`` by its bounds and relax its outputs.

    Sets STATE_LOW, STATE_HIGH of the row and SLOPE, OFFSET, ERROR of its columns.
    """
    knot, knots = tables.first_knot[unit], tables.knots
    pieces = tables.first_knot[unit + 1] - knot + 1
    first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
    low, high = X[LOW * M + r], X[HIGH * M + r]
    if first < last:
        radius = X[RADIUS * M + r]
        margin = 0.0
        if radius > 0.0:
            low -= radius
            high += radius
            size = abs(X[r]) + abs(X[M + r]) + abs(X[2 * M + r]) + abs(X[3 * M + r]) + radius
            margin = MARGIN * size * tables.extent
        while first < last and low - margin >= knots[knot + first]:
            first += 1
        while last > first and high + margin < knots[knot + last - 1]:
            last -= 1
        # A cell that was split here lies on one side of the knot, whatever the radius says.
        if first > 0 and low < knots[knot + first - 1] < high:
            low = knots[knot + first - 1]
        if last < pieces - 1 and low < knots[knot + last] < high:
            high = knots[knot + last]
        J[STATE_LOW * M + r] = first
        J[STATE_HIGH * M + r] = last
        X[LOW * M + r] = low
        X[HIGH * M + r] = high
    piece = tables.first_piece[unit]
    for c in range(N[cols + r], N[cols + r + 1]):
        if first == last:
            X[SLOPE * M + c] = tables.slopes[piece + first]
            X[OFFSET * M + c] = tables.intercepts[piece + first]
            X[ERROR * M + c] = 0.0
        else:
            slope, offset, error = relax_piece_range(
                knots, tables.slopes, tables.intercepts, knot, piece, first, last, low, high
            )
            X[SLOPE * M + c] = slope
            X[OFFSET * M + c] = offset
            X[ERROR * M + c] = error
        piece += pieces


@njit(cache=True, error_model="numpy")
def remember_outputs(N, X, J, M, row_col, rows, r, count):
    """Append the relaxed outputs of row ``r`` that are not identically zero to the list that later rows read.

    Entry ``p``: J[READ_COLS] the column, J[READ_AT] where its weights begin, and five numbers at ``X[OUTPUTS] + 8 p``:
    the affine form and the half width of y. Returns the new length of the list.
    """
    for c in range(N[row_col + r], N[row_col + r + 1]):
        slope, offset, error = X[SLOPE * M + c], X[OFFSET * M + c], X[ERROR * M + c]
        if slope != 0.0 or offset != 0.0 or error != 0.0:
            J[READ_COLS * M + count] = c
            J[READ_AT * M + count] = c * rows
            at = OUTPUTS * M + 8 * count
            X[at] = slope * X[r]
            X[at + 1] = slope * X[M + r]
            X[at + 2] = slope * X[2 * M + r]
            X[at + 3] = slope * X[3 * M + r] + offset
            X[at + 4] = abs(slope) * X[RADIUS * M + r] + error
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def read_outputs(F, X, J, M, floats, rows, begin, end, first, count):
    """Centres and radii of rows ``begin:end``: their affine parts plus what they read of outputs ``first:count``."""
    weights = floats + 4 * rows
    outputs = OUTPUTS * M
    places = READ_AT * M
    r = begin
    while r + 8 <= end:
        c0, c1 = load(F, floats + r), load(F, floats + rows + r)
        c2, c3 = load(F, floats + 2 * rows + r), load(F, floats + 3 * rows + r)
        d0, d1 = load(F, floats + r + 4), load(F, floats + rows + r + 4)
        d2, d3 = load(F, floats + 2 * rows + r + 4), load(F, floats + 3 * rows + r + 4)
        c4, d4 = splat(0.0), splat(0.0)
        for p in range(first, count):
            at = weights + J[places + p] + r
            w, v = load(F, at), load(F, at + 4)
            y = outputs + 8 * p
            y0, y1, y2, y3, y4 = splat(X[y]), splat(X[y + 1]), splat(X[y + 2]), splat(X[y + 3]), splat(X[y + 4])
            c0, d0 = fma(w, y0, c0), fma(v, y0, d0)
            c1, d1 = fma(w, y1, c1), fma(v, y1, d1)
            c2, d2 = fma(w, y2, c2), fma(v, y2, d2)
            c3, d3 = fma(w, y3, c3), fma(v, y3, d3)
            c4, d4 = fma(magnitude(w), y4, c4), fma(magnitude(v), y4, d4)
        store(X, r, c0)
        store(X, M + r, c1)
        store(X, 2 * M + r, c2)
        store(X, 3 * M + r, c3)
        store(X, RADIUS * M + r, c4)
        store(X, r + 4, d0)
        store(X, M + r + 4, d1)
        store(X, 2 * M + r + 4, d2)
        store(X, 3 * M + r + 4, d3)
        store(X, RADIUS * M + r + 4, d4)
        r += 8
    if r < end:
        c0, c1 = load(F, floats + r), load(F, floats + rows + r)
        c2, c3 = load(F, floats + 2 * rows + r), load(F, floats + 3 * rows + r)
        radius = splat(0.0)
        for p in range(first, count):
            w = load(F, weights + J[places + p] + r)
            y = outputs + 8 * p
            c0 = fma(w, splat(X[y]), c0)
            c1 = fma(w, splat(X[y + 1]), c1)
            c2 = fma(w, splat(X[y + 2]), c2)
            c3 = fma(w, splat(X[y + 3]), c3)
            radius = fma(magnitude(w), splat(X[y + 4]), radius)
        store(X, r, c0)
        store(X, M + r, c1)
        store(X, 2 * M + r, c2)
        store(X, 3 * M + r, c3)
        store(X, RADIUS * M + r, radius)


@njit(cache=True, error_model="numpy")
def bound_units(F, N, X, J, M, tables, cell, system, floats):
    """Forward pass: bounds, states and relaxations of all rows of the system over the cell.

    Reads the row states in J (STATE_LOW, STATE_HIGH) and narrows them, and sets the rows' KIND. Returns the numbers of
    settled rows whose output is not identically zero (LINEAR), and whose is (DEAD).
    """
    rows, cols, levels = N[system + SYS_ROWS], N[system + SYS_COLS], N[system + SYS_LEVELS]
    level_start = system + SYS_HEADER
    row_unit = level_start + levels + 1
    row_col = row_unit + rows
    col_end = row_col + rows + 1 + 2 * cols
    first, count, linear, dead = 0, 0, 0, 0
    for level in range(levels):
        begin, end = N[level_start + level], N[level_start + level + 1]
        # The outputs that no later row reads are at the front: extents only grow with the level.
        while first < count and N[col_end + J[READ_COLS * M + first]] <= begin:
            first += 1
        read_outputs(F, X, J, M, floats, rows, begin, end, first, count)
        row_extremes(F, N, X, M, cell, begin, end)
        for r in range(begin, end):
            unit = N[row_unit + r]
            if unit < 0:
                continue
            settle_row(N, X, J, M, tables, row_col, r, unit)
            before = count
            count = remember_outputs(N, X, J, M, row_col, rows, r, count)
            if J[STATE_LOW * M + r] < J[STATE_HIGH * M + r]:
                J[KIND * M + r] = UNSTABLE
            elif count > before:
                J[KIND * M + r] = LINEAR
                linear += 1
            else:
                J[KIND * M + r] = DEAD
                dead += 1
    return linear, dead


@njit(cache=True, error_model="numpy")
def bound_output(F, N, X, M, system, floats):
    """Backward pass: the output's linear centre (X[CENTRE_AT], four numbers) and its radius, which is returned."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_row = row_col + rows + 1
    col_begin = col_row + cols
    col_end = col_begin + cols
    weights = floats + 4 * rows
    out_weights = weights + cols * rows
    multiplier = OUT_COEF * M  # d output / d pre-activation, per row, along the chords
    zero = splat(0.0)
    for r in range(0, rows, 4):
        store(X, multiplier + r, zero)
    radius, constant = 0.0, 0.0
    for c in range(cols - 1, -1, -1):
        begin, end = N[col_begin + c], N[col_end + c]
        total = zero
        for q in range(begin, end, 4):
            total = fma(load(X, multiplier + q), load(F, weights + c * rows + q), total)
        coefficient = F[out_weights + c] + ((lane(total, 0) + lane(total, 1)) + (lane(total, 2) + lane(total, 3)))
        X[multiplier + N[col_row + c]] += coefficient * X[SLOPE * M + c]
        constant += coefficient * X[OFFSET * M + c]
        radius += abs(coefficient) * X[ERROR * M + c]
    s0, s1, s2, s3 = zero, zero, zero, zero
    for r in range(0, rows, 4):
        m = load(X, multiplier + r)
        s0 = fma(m, load(F, floats + r), s0)
        s1 = fma(m, load(F, floats + rows + r), s1)
        s2 = fma(m, load(F, floats + 2 * rows + r), s2)
        s3 = fma(m, load(F, floats + 3 * rows + r), s3)
    out = out_weights + padded(cols)
    at = CENTRE_AT * M
    X[at] = F[out] + ((lane(s0, 0) + lane(s0, 1)) + (lane(s0, 2) + lane(s0, 3)))
    X[at + 1] = F[out + 1] + ((lane(s1, 0) + lane(s1, 1)) + (lane(s1, 2) + lane(s1, 3)))
    X[at + 2] = F[out + 2] + ((lane(s2, 0) + lane(s2, 1)) + (lane(s2, 2) + lane(s2, 3)))
    X[at + 3] = F[out + 3] + constant + ((lane(s3, 0) + lane(s3, 1)) + (lane(s3, 2) + lane(s3, 3)))
    return radius


@njit(cache=True, error_model="numpy")
def value_range(X, M, region, count):
    """Smallest and largest of the first ``count`` (a multiple of the lane width) values of a region."""
    low = load(X, region * M)
    high = low
    for v in range(4, count, 4):
        value = load(X, region * M + v)
        low = smaller(value, low)
        high = larger(value, high)
    return (
        min(min(lane(low, 0), lane(low, 1)), min(lane(low, 2), lane(low, 3))),
        max(max(lane(high, 0), lane(high, 1)), max(lane(high, 2), lane(high, 3))),
    )
