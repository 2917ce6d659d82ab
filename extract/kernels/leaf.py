"""Small cells: every linear piece of the surface in a cell with few unstable units, without splitting the cell.

The states of the remaining units are enumerated in topological order. Under each choice every pre-activation and the
output are affine, so the piece is the polygon in which f = 0 cuts the cell, clipped by the knots of the units that have
more than one possible state. Cutting a polygon is several times cheaper than splitting a polytope.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import fma, lanes_of, load, splat, store
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_VERTICES,
    CHOICE,
    CHOICE_FIRST,
    CHOICE_LAST,
    CHOSEN,
    FORMS,
    OUT_VALUES,
    POLY_A,
    POLY_B,
    POLY_VALUES,
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_HASH,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    TAGS_A,
    TAGS_B,
    VALUES,
    first_trim_tag,
    padded,
    weights_of,
)
from mn_onnx.extract.kernels.polytope import (
    TINY,
    clip_polygon,
    count_corners_inside,
    evaluate_affine,
    find_cut_edges,
    link_cut_edges,
    read_cut_polygon,
    value_range,
)
from mn_onnx.ir.kernel import kernel

# So many recent points are looked at for each corner: they fit in the nearest cache and find 96 % of what there is.
REMEMBERED = 2048
# Corners of one vertex that are further from one another, relative to their coordinates, are left for `weld` to judge.
APART = 2.0**-40
# Values this small, relative to the extent of the box and the slope, may be zero but for rounding.
ROUNDING = 1e-13


@kernel
def place_corner(output, points, key0, key1, x, y, z):
    """The number of the point with these keys at this place: a recent one of ``points``, or the next.

    Three of four corners lie at a point that polygons emitted shortly before have too; `weld` finds the others. A
    point of the same keys that is `APART` from here is another one, so that `weld` can report it.
    """
    apart = APART * (abs(x) + abs(y) + abs(z))
    slot = key0 & (REMEMBERED - 1)
    recent = np.int64(output.remembered[slot])  # of these buffers, or of others that were here before
    known = (
        (recent < points)
        & (output.keys[2 * recent] == key0)
        & (output.keys[2 * recent + 1] == key1)
        & (abs(output.positions[3 * recent] - x) <= apart)
        & (abs(output.positions[3 * recent + 1] - y) <= apart)
        & (abs(output.positions[3 * recent + 2] - z) <= apart)
    )
    # Whether it is known is hard to guess, so the next point is written in any case.
    output.positions[3 * points] = x
    output.positions[3 * points + 1] = y
    output.positions[3 * points + 2] = z
    output.keys[2 * points] = key0
    output.keys[2 * points + 1] = key1
    point = recent if known else points
    output.remembered[slot] = point
    return point


@kernel
def emit_polygon(X, J, M, output, tables, count, polygon, tags, hash0, hash1, gradient):
    """Append a polygon to the output buffers; the caller has made sure that they have room."""
    corner, points = output.counts[1], output.counts[2]
    for j in range(count):
        before = J[tags * M + (j - 1 if j > 0 else count - 1)]
        after = J[tags * M + j]
        key0 = hash0 ^ tables.tag_hash[2 * before] ^ tables.tag_hash[2 * after]
        key1 = hash1 ^ tables.tag_hash[2 * before + 1] ^ tables.tag_hash[2 * after + 1]
        x, y, z = X[polygon * M + j], X[(polygon + 1) * M + j], X[(polygon + 2) * M + j]
        point = place_corner(output, points, key0, key1, x, y, z)
        output.corners[corner + j] = point
        points += point == points
        output.box_faces[corner + j] = (after >> 1) - tables.n_knots if after >= 2 * tables.n_knots else -1
    face = output.counts[0]
    output.sizes[face] = count
    for axis in range(3):
        output.gradients[3 * face + axis] = X[gradient + axis]
    output.counts[0] = face + 1
    output.counts[1] = corner + count
    output.counts[2] = points


@kernel
def choose_state(N, X, J, M, system, tables, r, state):
    """Let row ``r`` be in a state, and its outputs, X[CHOSEN], the affine forms that they are then."""
    J[CHOICE * M + r] = state
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    row_col = row_unit + N[system + SYS_ROWS]
    unit = N[row_unit + r]
    pieces = tables.first_knot[unit + 1] - tables.first_knot[unit] + 1
    piece = tables.first_piece[unit] + state
    form = load(X, FORMS * M + 4 * r)
    for c in range(N[row_col + r], N[row_col + r + 1]):
        constant = lanes_of(0.0, 0.0, 0.0, tables.intercepts[piece])
        store(X, CHOSEN * M + 4 * c, fma(splat(tables.slopes[piece]), form, constant))
        piece += pieces


@kernel
def substitute(F, X, M, form, first, count, weights, stride):
    """The affine ``form`` plus what it reads of the outputs ``first : count``, as chosen.

    The weight on column ``c`` is ``F[weights + c * stride]``.
    """
    for c in range(first, count):
        form = fma(splat(F[weights + c * stride]), load(X, CHOSEN * M + 4 * c), form)
    return form


@kernel
def substitute_row(F, N, X, M, system, floats, r, target):
    """Affine form of row ``r`` at ``X[target : target + 4]`` under the states chosen for the rows before it."""
    rows, cols, at = N[system + SYS_ROWS], N[system + SYS_COLS], floats + r
    row_col = system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + rows
    col_begin = row_col + rows + 1 + cols
    first, count = np.int64(0), N[row_col + r]
    while first < count and N[col_begin + cols + first] <= r:
        first += 1
    while count > first and N[col_begin + count - 1] > r:
        count -= 1
    form = lanes_of(F[at], F[at + rows], F[at + 2 * rows], F[at + 3 * rows])
    store(X, target, substitute(F, X, M, form, first, count, weights_of(floats, rows) + r, rows))


@kernel
def substitute_output(F, N, X, M, system, floats, target):
    """Affine form of the output at ``X[target : target + 4]`` under the chosen states of all rows."""
    rows, cols = N[system + SYS_ROWS], N[system + SYS_COLS]
    out_weights = weights_of(floats, rows) + cols * rows
    form = load(F, out_weights + padded(cols))
    store(X, target, substitute(F, X, M, form, np.int64(0), cols, out_weights, np.int64(1)))


@kernel
def count_small(X, values, count, rounding):
    """How many of ``X[values : values + count]`` are not zero but may be, by rounding."""
    small = 0
    for v in range(values, values + count):
        if TINY < abs(X[v]) <= rounding:
            small += 1
    return small


@kernel
def emit_choice(F, N, X, J, M, output, tables, slot_of_tag, cell, cell_rows, system, floats):
    """Emit the polygon of the chosen states, if the surface has one there.

    Returns 1 if the cell is too degenerate to be cut, if rounding decides whether there is a polygon, or if the polygon
    reaches a plane that trimmed the cell, else 0.
    """
    rows = N[system + SYS_ROWS]
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    gradient = FORMS * M + 4 * rows
    substitute_output(F, N, X, M, system, floats, gradient)
    evaluate_affine(F, N, X, M, cell, OUT_VALUES, X[gradient], X[gradient + 1], X[gradient + 2], X[gradient + 3])
    low, high = value_range(X, M, OUT_VALUES, N[cell + CELL_CAPACITY])
    rounding = ROUNDING * tables.extent * (abs(X[gradient]) + abs(X[gradient + 1]) + abs(X[gradient + 2]))
    if low > rounding or high < -rounding:
        return 0
    # If the surface may lie in a face of the cell, rounding would decide whether it is there, and in which piece.
    one_sided = low >= -rounding or high <= rounding
    if one_sided and count_small(X, OUT_VALUES * M, N[cell + CELL_VERTICES], rounding) >= 3:
        return 1
    if low >= 0.0 or high < 0.0:
        return 0
    count = find_cut_edges(F, N, X, J, M, cell, cell_rows, OUT_VALUES)
    if not link_cut_edges(J, M, slot_of_tag, count):
        return 1
    polygon, tags, other, other_tags = POLY_A, TAGS_A, POLY_B, TAGS_B
    read_cut_polygon(X, J, M, count, polygon, tags)
    hash0, hash1 = N[system + SYS_HASH], N[system + SYS_HASH + 1]
    for r in range(rows):
        unit = N[row_unit + r]
        if unit < 0:
            continue
        knot = tables.first_knot[unit]
        state = J[CHOICE * M + r]
        hash0 ^= tables.state_hash[2 * (knot + unit + state)]
        hash1 ^= tables.state_hash[2 * (knot + unit + state) + 1]
        at = FORMS * M + 4 * r
        for side in range(2):
            # side 1: the state's lower knot, to its right; side 0: its upper knot, to its left.
            if state == (J[CHOICE_FIRST * M + r] if side == 1 else J[CHOICE_LAST * M + r]):
                continue
            plane = knot + state - side
            constant = X[at + 3] - tables.knots[plane]
            inside = count_corners_inside(X, M, count, polygon, X[at], X[at + 1], X[at + 2], constant, side, gradient)
            if inside == count:
                continue
            # If all of the polygon may lie on the knot, rounding would decide which piece has it, if any.
            rounding = ROUNDING * tables.extent * (abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]))
            if abs(X[POLY_VALUES * M]) <= rounding and count_small(X, POLY_VALUES * M, count, rounding) == count:
                return 1
            if inside == 0:
                return 0
            tag = 2 * plane + side
            count = clip_polygon(X, J, M, count, polygon, tags, other, other_tags, side, tag)
            polygon, tags, other, other_tags = other, other_tags, polygon, tags
    for j in range(count):
        if J[tags * M + j] >= first_trim_tag(tables.n_knots):
            return 1
    emit_polygon(X, J, M, output, tables, count, polygon, tags, hash0, hash1, gradient)
    return 0


@kernel
def open_choice(F, N, X, J, M, tables, cell, system, floats, r):
    """Find the states that row ``r`` can take in the cell, given those chosen before, and choose the first."""
    unit = N[system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + r]
    if unit < 0:
        J[CHOICE * M + r] = 0
        J[CHOICE_LAST * M + r] = 0
        return
    at = FORMS * M + 4 * r
    substitute_row(F, N, X, M, system, floats, r, at)
    evaluate_affine(F, N, X, M, cell, VALUES, X[at], X[at + 1], X[at + 2], X[at + 3])
    low, high = value_range(X, M, VALUES, N[cell + CELL_CAPACITY])
    first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
    knot = tables.first_knot[unit]
    while first < last and low >= tables.knots[knot + first]:
        first += 1
    while last > first and high < tables.knots[knot + last - 1]:
        last -= 1
    J[CHOICE_FIRST * M + r] = first
    J[CHOICE_LAST * M + r] = last
    choose_state(N, X, J, M, system, tables, r, first)


@kernel
def emit_leaf(F, N, X, J, M, output, tables, slot_of_tag, cell, cell_rows, system, floats):
    """Enumerate the states of a small folded system over a cell and emit every polygon.

    The cell's own state rows belong to another system (``cell_rows`` of them); the states of this system's rows are
    J[STATE_LOW], J[STATE_HIGH]. Returns the number of choices for which the cell was too degenerate to be cut.
    """
    rows = N[system + SYS_ROWS]
    broken = 0
    r = np.int64(0)
    opening = True
    while True:
        if opening:
            while r < rows:
                open_choice(F, N, X, J, M, tables, cell, system, floats, r)
                r += 1
            broken += emit_choice(F, N, X, J, M, output, tables, slot_of_tag, cell, cell_rows, system, floats)
            opening = False
        r -= 1
        if r < 0:
            return broken
        if J[CHOICE * M + r] < J[CHOICE_LAST * M + r]:
            choose_state(N, X, J, M, system, tables, r, J[CHOICE * M + r] + 1)
            r += 1
            opening = True
