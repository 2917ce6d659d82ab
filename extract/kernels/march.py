"""Branch and fold: the depth-first traversal of one worker, resumable after any cell.

A cell is bounded, dropped if the output cannot reach the level there, folded when enough of its units have settled, and
split along a knot of a unit whose pre-activation is already affine on it; small cells are emitted whole (`leaf`).
`march` returns to its caller, with the worker's state intact, when a budget of work is used up, when an arena or an
output buffer might not have room for the next cell, or when it is told to stop.
"""

from __future__ import annotations

from typing import NamedTuple

from numba import njit

from mn_onnx.extract.kernels.bound import MARGIN, bound_output, bound_units, value_range
from mn_onnx.extract.kernels.fold import carry_states, fold, folding_floats
from mn_onnx.extract.kernels.lanes import cycles, pointer
from mn_onnx.extract.kernels.leaf import emit_leaf
from mn_onnx.extract.kernels.memory import (
    ABOVE,
    BELOW,
    CELL_CAPACITY,
    CELL_DEPTH,
    CELL_END_F,
    CELL_END_I,
    CELL_HEADER,
    CELL_SYSTEM_F,
    CELL_SYSTEM_I,
    CELL_VERTICES,
    CENTRE_AT,
    CUT_FROM,
    CUT_SHARE,
    CUT_TO,
    DEAD,
    HIGH,
    LINEAR,
    LOW,
    NEW_INDEX,
    OUT_VALUES,
    RADIUS,
    SIDE_COUNTS,
    STATE_HIGH,
    STATE_LOW,
    SYS_COLS,
    SYS_FLOATS,
    SYS_HEADER,
    SYS_INTS,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_UNITS,
    UNSTABLE,
    VALUES,
    X_REGIONS,
    cell_ints,
    padded,
    system_ints,
)
from mn_onnx.extract.kernels.polytope import evaluate_affine, find_cut_edges, link_cut_edges, write_half
from mn_onnx.extract.kernels.records import OutputArrays, Tables

DONE, BUDGET_USED, ARENA_FULL, SCRATCH_FULL, OUTPUT_FULL, STACK_FULL, STOPPED = 0, 1, 2, 3, 4, 5, 6

# Entries of the control array.
(STACK_BOTTOM, STACK_TOP, TOP_F, TOP_I, STOP, LEAF_CHOICES, NODES, PRUNED, LEAVES, FOLDS, WORK, NEED_F, NEED_I) = range(
    13
)
(BROKEN_CUTS, DEEPEST, NEED_CORNERS, NEED_POLYGONS, CHILDREN_PRUNED, PROFILE) = range(13, 19)
# Per power of two of unstable units: nodes, cycles.
PROFILE_BINS = 16
CONTROL_SIZE = PROFILE + 2 * PROFILE_BINS


class Room(NamedTuple):
    """Sizes of a worker's arrays: arenas, scratch regions, stack, and output buffers in polygons and corners."""

    floats: int
    integers: int
    scratch: int
    stack: int
    polygons: int
    corners: int


@njit(cache=True, error_model="numpy")
def point_at_tables(tables):
    """The tables with pointers in place of arrays."""
    return Tables(
        pointer(tables.first_knot),
        pointer(tables.knots),
        pointer(tables.first_piece),
        pointer(tables.slopes),
        pointer(tables.intercepts),
        pointer(tables.state_hash),
        pointer(tables.tag_hash),
        tables.n_knots,
        tables.extent,
    )


@njit(cache=True, error_model="numpy")
def point_at_output(output):
    """The output buffers with pointers in place of arrays."""
    return OutputArrays(
        pointer(output.counts),
        pointer(output.sizes),
        pointer(output.gradients),
        pointer(output.positions),
        pointer(output.keys),
        pointer(output.box_faces),
    )


@njit(cache=True, error_model="numpy")
def missing_room(N, control, room, counts, cell, rows, cols, levels):
    """The status to return if the next cell might not fit anywhere, else DONE; sets the NEED_* entries."""
    vertices = N[cell + CELL_VERTICES]
    most = 2 * vertices + 8
    choices = control[LEAF_CHOICES]
    need_f = control[TOP_F] + folding_floats(rows, cols) + 6 * padded(most)
    need_i = control[TOP_I] + system_ints(rows, cols, levels) + 2 * cell_ints(rows, most)
    if need_f > room.floats or need_i > room.integers:
        control[NEED_F], control[NEED_I] = need_f, need_i
        return ARENA_FULL
    if most + 2 * choices > room.scratch:
        control[NEED_I] = most + 2 * choices
        return SCRATCH_FULL
    if control[STACK_TOP] + 2 > room.stack:
        return STACK_FULL
    polygons, corners = choices, choices * (vertices + 2 * choices + 8)
    if counts[0] + polygons > room.polygons or counts[1] + corners > room.corners:
        control[NEED_POLYGONS], control[NEED_CORNERS] = polygons, corners
        return OUTPUT_FULL
    return DONE


@njit(cache=True, error_model="numpy")
def count_choices(N, J, M, system, most):
    """Product of the numbers of states the rows still have, or anything above ``most``."""
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    product = 1
    for r in range(N[system + SYS_ROWS]):
        if N[row_unit + r] >= 0:
            product *= J[STATE_HIGH * M + r] - J[STATE_LOW * M + r] + 1
            if product > most:
                return product
    return product


@njit(cache=True, error_model="numpy")
def choose_split(N, X, J, M, tables, system):
    """Row and knot to split at: of the unstable rows that are affine on the cell, the one that cuts deepest."""
    row_unit = system + SYS_HEADER + N[system + SYS_LEVELS] + 1
    best, best_row, best_knot = -1.0, -1, 0
    for r in range(N[system + SYS_ROWS]):
        first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
        if N[row_unit + r] < 0 or first == last or X[RADIUS * M + r] > 0.0:
            continue
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
    return best_row, best_knot


@njit(cache=True, error_model="numpy")
def half_range(X, J, M, count, side):
    """Range of the output's centre over the vertices of one half of a split cell."""
    low, high = 1e308, -1e308
    out = OUT_VALUES * M
    members = (BELOW if side == 0 else ABOVE) * M
    for w in range(J[SIDE_COUNTS * M + side]):
        value = X[out + J[members + w]]
        low, high = min(low, value), max(high, value)
    for j in range(count):
        v, u = J[CUT_FROM * M + j] // 3, J[CUT_TO * M + j] // 3
        value = X[out + v] + X[CUT_SHARE * M + j] * (X[out + u] - X[out + v])
        low, high = min(low, value), max(high, value)
    return low, high


@njit(cache=True, error_model="numpy")
def push_half(F, N, X, J, M, control, stack, cell, cell_rows, system, floats, count, side, row, knot, tag):
    """Push one half of the cell, cut as `find_cut_edges` found, as a cell over ``system`` whose states are in J."""
    rows = N[system + SYS_ROWS]
    half, half_floats = control[TOP_I], control[TOP_F]
    total = write_half(F, N, X, J, M, cell, cell_rows, rows, count, side, tag, half, half_floats)
    N[half + CELL_SYSTEM_F], N[half + CELL_SYSTEM_I] = floats, system
    N[half + CELL_DEPTH] = N[cell + CELL_DEPTH] + 1
    states = half + CELL_HEADER
    for r in range(rows):
        N[states + r] = J[STATE_LOW * M + r]
        N[states + rows + r] = J[STATE_HIGH * M + r]
    if side == 0:
        N[states + rows + row] = knot
    else:
        N[states + row] = knot + 1
    control[TOP_F] = half_floats + 3 * N[half + CELL_CAPACITY]
    control[TOP_I] = half + cell_ints(rows, total)
    N[half + CELL_END_F], N[half + CELL_END_I] = control[TOP_F], control[TOP_I]
    stack[control[STACK_TOP]] = half
    control[STACK_TOP] += 1


@njit(cache=True, error_model="numpy")
def split_cell(
    F, N, X, J, M, control, stack, tables, slot_of_tag, cell, cell_rows, system, floats, row, form, knot, slack
):
    """Push both halves of a cell, less those that the output's centre and ``slack`` exclude.

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
    for side in (1, 0):
        low, high = half_range(X, J, M, count, side)
        if low > slack or high < -slack:
            control[CHILDREN_PRUNED] += 1
            continue
        push_half(
            F, N, X, J, M, control, stack, cell, cell_rows, system, floats, count, side, row, knot, 2 * plane + side
        )


@njit(cache=True, error_model="numpy")
def how_to_fold(N, system, linear, dead):
    """UNSTABLE to fold all settled rows of the system, LINEAR to leave out the dead ones, DEAD to keep it as it is.

    Substitution costs the cube of the number of units, bounding its square, and leaving out dead rows keeps the zeros
    between layers that are not neighbours: so the more units there are, the longer substitution is put off.
    """
    units = N[system + SYS_UNITS]
    if units < 64:
        return UNSTABLE if 3 * (linear + dead) >= units else DEAD
    if 7 * linear >= units:
        return UNSTABLE
    return LINEAR if 7 * dead >= units else DEAD


@njit(cache=True, error_model="numpy")
def visit(F, N, X, J, M, control, stack, output, tables, slot_of_tag, cell):
    """Process one cell that has been taken off the stack."""
    floats, system = N[cell + CELL_SYSTEM_F], N[cell + CELL_SYSTEM_I]
    rows = N[system + SYS_ROWS]
    states = cell + CELL_HEADER
    for r in range(rows):
        J[STATE_LOW * M + r] = N[states + r]
        J[STATE_HIGH * M + r] = N[states + rows + r]
    linear, dead = bound_units(F, N, X, J, M, tables, cell, system, floats)
    radius = bound_output(F, N, X, M, system, floats)
    at = CENTRE_AT * M
    evaluate_affine(F, N, X, M, cell, OUT_VALUES, X[at], X[at + 1], X[at + 2], X[at + 3])
    low, high = value_range(X, M, OUT_VALUES, N[cell + CELL_CAPACITY])
    size = abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]) + abs(X[at + 3]) + radius
    slack = radius + MARGIN * size * tables.extent
    if low > slack or high < -slack:
        control[PRUNED] += 1
        return
    folded, folded_floats = system, floats
    choices = count_choices(N, J, M, system, control[LEAF_CHOICES])
    leaf = choices <= control[LEAF_CHOICES]
    row, knot = -1, 0
    if not leaf:
        row, knot = choose_split(N, X, J, M, tables, system)
    form = row
    least = UNSTABLE if leaf else how_to_fold(N, system, linear, dead)
    if least > DEAD:
        folded, folded_floats = control[TOP_I], control[TOP_F]
        fold(F, N, X, J, M, system, floats, folded, folded_floats, least)
        carry_states(N, J, M, tables, system, folded, least)
        control[TOP_F] = folded_floats + N[folded + SYS_FLOATS]
        control[TOP_I] = folded + N[folded + SYS_INTS]
        control[FOLDS] += 1
        if not leaf:
            row = J[NEW_INDEX * M + row]
    if leaf:
        control[LEAVES] += 1
        control[BROKEN_CUTS] += emit_leaf(F, N, X, J, M, output, tables, slot_of_tag, cell, rows, folded, folded_floats)
        return
    split_cell(
        F, N, X, J, M, control, stack, tables, slot_of_tag, cell, rows, folded, folded_floats, row, form, knot, slack
    )


@njit(cache=True, nogil=True, error_model="numpy")
def march(worker, tables, output, budget):
    """Visit cells until the worker's stack is empty; returns one of the status codes of this module.

    ``worker``: `WorkerArrays`; ``tables``: `Tables`; ``output``: `OutputArrays`; ``budget``: about
    how many weights to read before returning BUDGET_USED.
    """
    M = worker.X.size // X_REGIONS
    F, N, X, J = pointer(worker.F), pointer(worker.N), pointer(worker.X), pointer(worker.J)
    control, stack, slot_of_tag = pointer(worker.control), pointer(worker.stack), pointer(worker.slot_of_tag)
    knots = point_at_tables(tables)
    buffers = point_at_output(output)
    room = Room(worker.F.size, worker.N.size, M, worker.stack.size, output.sizes.size, output.box_faces.size)
    used = 0
    while control[STACK_TOP] > control[STACK_BOTTOM]:
        if control[STOP] != 0:
            return STOPPED
        if used > budget:
            return BUDGET_USED
        cell = stack[control[STACK_TOP] - 1]
        system = N[cell + CELL_SYSTEM_I]
        rows, cols, levels = N[system + SYS_ROWS], N[system + SYS_COLS], N[system + SYS_LEVELS]
        control[TOP_F], control[TOP_I] = N[cell + CELL_END_F], N[cell + CELL_END_I]
        status = missing_room(N, control, room, output.counts, cell, rows, cols, levels)
        if status != DONE:
            return status
        control[STACK_TOP] -= 1
        control[NODES] += 1
        control[DEEPEST] = max(control[DEEPEST], N[cell + CELL_DEPTH])
        used += 200 + rows * cols
        before = cycles()
        visit(F, N, X, J, M, control, stack, buffers, knots, slot_of_tag, cell)
        bin_ = 0
        units = N[system + SYS_UNITS]
        while units > 0:
            bin_ += 1
            units >>= 1
        control[PROFILE + bin_] += 1
        control[PROFILE + PROFILE_BINS + bin_] += cycles() - before
    return DONE
