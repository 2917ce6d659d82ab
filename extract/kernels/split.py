"""Dividing a cell: what is trimmed off it, where it is split, and how its parts are pushed."""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.control import BROKEN_CUTS, STACK_TOP, TOP_F, TOP_I
from mn_onnx.extract.kernels.lanes import load_wide, splat_wide
from mn_onnx.extract.kernels.masks import (
    at_least,
    bits_of,
    both,
    count_up,
    is_below,
    load_integers,
    lowest_bit,
    same,
    splat_integer,
    without,
)
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_DEPTH,
    CELL_END_F,
    CELL_END_I,
    CELL_FLOATS,
    CELL_HEADER,
    CELL_SINCE,
    CELL_SYSTEM_F,
    CELL_SYSTEM_I,
    CENTRE_AT,
    HIGH,
    KIND,
    LOW,
    RADIUS,
    SIDE_COUNTS,
    STATE_HIGH,
    STATE_LOW,
    SYS_HEADER,
    SYS_LEVELS,
    SYS_ROWS,
    TRIMMED_DEPTHS,
    UNSTABLE,
    VALUES,
    cell_ints,
    first_trim_tag,
)
from mn_onnx.extract.kernels.polytope import copy_polytope, evaluate_affine, find_cut_edges, link_cut_edges, write_half
from mn_onnx.ir.kernel import kernel

# A cell is trimmed if at most this share of the output's range stays. Measured: 0.5 to 0.8 do equally well.
TRIMMED_SHARE = 0.7
# The same for cells that are shaved then, from where they were trimmed: 2 to 4 % faster than the share above.
SHAVED_TRIMMED_SHARE = 0.9
# Never thinner than this share of the range, nor than this multiple of what the output's centre is summed of: the signs
# at the vertices of still flatter cells would be rounding.
THINNEST_SHARE, THINNEST = 0.03, 2.0**-30


@kernel
def affine_unstable(N, X, J, M, row_unit, r, rows):
    """Which of the eight rows from ``r`` on are unstable and affine on the cell, as bits."""
    real = both(at_least(load_integers(N, row_unit + r), splat_integer(0)), is_below(count_up(r), splat_integer(rows)))
    unstable = same(load_integers(J, KIND * M + r), splat_integer(UNSTABLE))
    return bits_of(without(both(real, unstable), is_below(splat_wide(0.0), load_wide(X, RADIUS * M + r))))


@kernel
def choose_split(N, X, J, M, tables, system):
    """Row and knot to split at: of the unstable rows that are affine on the cell, the one that cuts deepest."""
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    best, best_row, best_knot = -1.0, -1, 0
    rows = N[system + SYS_ROWS]
    chunk, left = np.int64(-8), np.int64(0)
    while True:
        while left == 0:
            chunk += 8
            if chunk >= rows:
                return best_row, best_knot
            left = affine_unstable(N, X, J, M, row_unit, chunk, rows)
        r = chunk + lowest_bit(left)
        left &= left - 1
        first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
        low, high = X[LOW * M + r], X[HIGH * M + r]
        knot = tables.first_knot[N[row_unit + r]]
        middle = 0.5 * (low + high)
        a, b = first, last - 1
        while a < b:
            mid = (a + b) >> 1
            if tables.knots[knot + mid] < middle:
                a = mid + 1
            else:
                b = mid
        if a > first and middle - tables.knots[knot + a - 1] < tables.knots[knot + a] - middle:
            a -= 1
        kappa = tables.knots[knot + a]
        norm = (X[r] * X[r] + X[M + r] * X[M + r] + X[2 * M + r] * X[2 * M + r]) ** 0.5
        score = min(high - kappa, kappa - low) / norm
        if score > best:
            best, best_row, best_knot = score, r, a


@kernel
def push_cell(N, J, M, control, stack, part, vertices, depth, since, system, floats, row, low, high):
    """Finish a cell whose polytope has been written at ``part``, and push it.

    Its states over ``system`` are those in J, except that ``row`` has ``low..high``.
    """
    rows = N[system + SYS_ROWS]
    N[part + CELL_SYSTEM_F], N[part + CELL_SYSTEM_I] = floats, system
    N[part + CELL_DEPTH], N[part + CELL_SINCE] = depth, since
    states = part + CELL_HEADER
    for r in range(rows):
        N[states + r] = J[STATE_LOW * M + r]
        N[states + rows + r] = J[STATE_HIGH * M + r]
    N[states + row], N[states + rows + row] = low, high
    control[TOP_F] = N[part + CELL_FLOATS] + 3 * N[part + CELL_CAPACITY]
    control[TOP_I] = part + cell_ints(rows, vertices)
    N[part + CELL_END_F], N[part + CELL_END_I] = control[TOP_F], control[TOP_I]
    stack[control[STACK_TOP]] = part
    control[STACK_TOP] += 1


@kernel
def split_cell(F, N, X, J, M, control, stack, tables, slot_of_tag, cell, cell_rows, system, floats, row, form, knot):
    """Push both halves of a cell, with the folded ``system``.

    A cell too degenerate to be cut is given up and counted; if the surface passes through it, its edges stay unmatched.
    ``form`` is the row that the splitting pre-activation has in X, ``row`` the one it has in ``system``.
    """
    unit = N[system + SYS_HEADER + N[system + SYS_LEVELS] + 1 + row]
    plane = tables.first_knot[unit] + knot
    evaluate_affine(
        F, N, X, M, cell, VALUES, X[form], X[M + form], X[2 * M + form], X[3 * M + form] - tables.knots[plane]
    )
    count = find_cut_edges(F, N, X, J, M, cell, cell_rows, VALUES)
    if not link_cut_edges(J, M, slot_of_tag, count):
        control[BROKEN_CUTS] += 1
        return
    rows, depth, since = N[system + SYS_ROWS], N[cell + CELL_DEPTH] + 1, N[cell + CELL_SINCE] + 1
    for side in (1, 0):
        # The plane may miss the cell by rounding: a knot is compared otherwise here than where it was chosen.
        if J[SIDE_COUNTS * M + side] == 0:
            continue
        part = control[TOP_I]
        vertices = write_half(F, N, X, J, M, cell, cell_rows, rows, count, side, 2 * plane + side, part, control[TOP_F])
        low = knot + 1 if side == 1 else J[STATE_LOW * M + row]
        high = knot if side == 0 else J[STATE_HIGH * M + row]
        push_cell(N, J, M, control, stack, part, vertices, depth, since, system, floats, row, low, high)


@kernel
def write_part(F, N, X, J, M, control, cell, rows, part_rows, count, side, tag):
    """Write one half of a cut cell at the top of the arenas, with room for the states of ``part_rows`` rows.

    Returns its place. The other arguments are those of `write_half`.
    """
    part = control[TOP_I]
    vertices = write_half(F, N, X, J, M, cell, rows, part_rows, count, side, tag, part, control[TOP_F])
    N[part + CELL_DEPTH], N[part + CELL_SINCE] = N[cell + CELL_DEPTH], N[cell + CELL_SINCE]
    control[TOP_F] += 3 * N[part + CELL_CAPACITY]
    control[TOP_I] += cell_ints(part_rows, vertices)
    return part


@kernel
def cut_away(F, N, X, J, M, control, slot_of_tag, cell, rows, sign, reach, tag):
    """The part of the cell where ``sign * c(x) >= -reach``, c the output's centre, with room for the cell's states.

    The cell itself if the plane misses it, or if it is too degenerate to be cut: trimming is never needed.
    """
    at = CENTRE_AT * M
    evaluate_affine(
        F, N, X, M, cell, VALUES, sign * X[at], sign * X[at + 1], sign * X[at + 2], sign * X[at + 3] + reach
    )
    count = find_cut_edges(F, N, X, J, M, cell, rows, VALUES)
    if count == 0 or not link_cut_edges(J, M, slot_of_tag, count):
        return cell
    return write_part(F, N, X, J, M, control, cell, rows, rows, count, np.int64(1), tag)


@kernel
def trim_cell(F, N, X, J, M, control, tables, slot_of_tag, cell, rows, low, high, slack, share):
    """The part of the cell between two planes that the surface cannot reach; the cell itself if most of it would stay.

    Most is more than ``share``. On the surface the output's centre is within ``slack``; on the cell it ranges over
    ``low..high``. What is cut off would take splits to be rid of, and of a flat cell all bounds are tighter. No polygon
    reaches the planes, so they leave no edge in the mesh.
    """
    at = CENTRE_AT * M
    size = abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]) + abs(X[at + 3])
    reach = max(slack, THINNEST_SHARE * (high - low), THINNEST * size * tables.extent)
    depth = N[cell + CELL_DEPTH]
    if depth >= TRIMMED_DEPTHS or min(high, reach) - max(low, -reach) > share * (high - low):
        return cell
    tag = first_trim_tag(tables.n_knots) + 2 * depth
    if high > reach:
        cell = cut_away(F, N, X, J, M, control, slot_of_tag, cell, rows, -1.0, reach, tag)
    if low < -reach:
        cell = cut_away(F, N, X, J, M, control, slot_of_tag, cell, rows, 1.0, reach, tag + 1)
    return cell


@kernel
def push_trimmed(F, N, J, M, control, stack, cell, cell_rows, system, floats, since):
    """Push a trimmed cell as it is, with the folded ``system``, and CELL_SINCE as given."""
    part, at = control[TOP_I], control[TOP_F]
    vertices = copy_polytope(F, N, cell, cell_rows, N[system + SYS_ROWS], part, at)
    depth = N[cell + CELL_DEPTH] + 1
    low, high = J[STATE_LOW * M], J[STATE_HIGH * M]
    push_cell(N, J, M, control, stack, part, vertices, depth, since, system, floats, np.int64(0), low, high)
