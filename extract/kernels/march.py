"""Branch and fold: the depth-first traversal of one worker, resumable after any cell.

A cell is bounded, dropped if the output cannot reach the level there, trimmed to where it can, in deep networks shaved
of slices that the surface misses (`shave`), folded when enough of its units have settled, and split along a knot of a
unit whose pre-activation is already affine on it; small cells are emitted whole (`leaf`). Large cells are bounded no
further than it seems worth it (LEAST_SETTLED), and in deep networks only at some depths (`how_to_bound`); then they are
only split.
`march` returns to its caller, with the worker's state intact, when a budget of work is used up, when it is asked for
work to share, when an arena or an output buffer might not have room for the next cell, or when it is told to stop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from mn_onnx.extract.kernels.bound import bound_first_level, bound_output, bound_units, settle_again
from mn_onnx.extract.kernels.control import (
    ASKED,
    BROKEN_CUTS,
    DEEPEST,
    FOLDS,
    LARGE_UNITS,
    LEAF_CHOICES,
    LEAVES,
    NEED_CORNERS,
    NEED_F,
    NEED_I,
    NEED_POLYGONS,
    NODES,
    PROFILE,
    PROFILE_BINS,
    PRUNED,
    SHAVED,
    STACK_BOTTOM,
    STACK_TOP,
    STOP,
    TOP_F,
    TOP_I,
    TRACKED_LEVELS,
    TRACKED_UNITS,
    TRIMMED,
)
from mn_onnx.extract.kernels.error_symbols import tracking_floats
from mn_onnx.extract.kernels.fold import fold, folding_floats
from mn_onnx.extract.kernels.lanes import cycles, pointer
from mn_onnx.extract.kernels.layout import carry_states, new_row
from mn_onnx.extract.kernels.leaf import emit_leaf
from mn_onnx.extract.kernels.memory import (
    CELL_DEPTH,
    CELL_END_F,
    CELL_END_I,
    CELL_HEADER,
    CELL_SINCE,
    CELL_SYSTEM_F,
    CELL_SYSTEM_I,
    CELL_VERTICES,
    DEAD,
    LINEAR,
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
    X_REGIONS,
    aligned,
    cell_ints,
    padded,
    system_ints,
)
from mn_onnx.extract.kernels.polytope import most_vertices
from mn_onnx.extract.kernels.records import OutputArrays, Tables
from mn_onnx.extract.kernels.shave import LOOSE_SHARE, NO_SURFACE, STATELESS, shave_cell
from mn_onnx.extract.kernels.split import (
    SHAVED_TRIMMED_SHARE,
    TRIMMED_SHARE,
    choose_split,
    push_trimmed,
    split_cell,
    trim_cell,
)
from mn_onnx.ir.kernel import inlined_kernel, kernel

DONE, BUDGET_USED, ARENA_FULL, SCRATCH_FULL, OUTPUT_FULL, STACK_FULL, STOPPED = 0, 1, 2, 3, 4, 5, 6

# Systems of fewer units are folded freely; see `how_to_fold`.
SMALL_SYSTEM = 64
# In deep systems, radii come from every unit's own error on cells of every third depth; such a bound costs twice as
# much and settles twice as many units. Between them, large systems are not bounded: what summed radii settle there is
# not worth reading the weights.
TRACKED_DEPTHS = 3
# Errors are tracked once more before a cell is split if no more than this share of its units is left after it has been
# trimmed or shaved: that costs little then. Measured: 1/2 to 4/5 do equally well.
TRACKED_AGAIN = 2 / 3
# What a cell takes besides its weights, in weights.
CELL_WORK = 8000
# How the units of a cell are bounded.
SUMMED, TRACKED, FIRST_LEVEL = 0, 1, 2


class Room(NamedTuple):
    """Sizes of a worker's arrays: arenas, scratch regions, stack; output buffers in polygons, corners and points."""

    floats: int
    integers: int
    scratch: int
    stack: int
    polygons: int
    corners: int
    points: int


@kernel
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


@kernel
def point_at_output(output):
    """The output buffers with pointers in place of arrays."""
    return OutputArrays(
        pointer(output.counts),
        pointer(output.sizes),
        pointer(output.gradients),
        pointer(output.corners),
        pointer(output.positions),
        pointer(output.keys),
        pointer(output.box_faces),
        pointer(output.remembered),
    )


@kernel
def parts_floats(vertices):
    """Room in F for what is left of a cell of so many vertices when it is trimmed and shaved: two cuts each."""
    return 4 * 3 * padded(most_vertices(vertices, np.int64(3)))


@kernel
def missing_room(N, control, room, counts, cell, rows, cols, levels):
    """The status to return if the next cell might not fit anywhere, else DONE; sets the NEED_* entries."""
    vertices = N[cell + CELL_VERTICES]
    # A cell is trimmed and shaved by planes of one direction, which comes to a cut on either side, then it is split.
    most = most_vertices(vertices, np.int64(3))
    parts = 2  # without states
    choices = control[LEAF_CHOICES]
    tracking = tracking_floats(rows, cols) if levels >= control[TRACKED_LEVELS] else 0
    after = folding_floats(rows, cols) + 3 * parts * padded(most)
    need_f = control[TOP_F] + parts_floats(vertices) + max(tracking, after)
    polytopes = 4 * cell_ints(rows, most) + parts * cell_ints(STATELESS, most)
    need_i = control[TOP_I] + system_ints(rows, cols, levels) + polytopes
    if need_f > room.floats or need_i > room.integers:
        control[NEED_F], control[NEED_I] = need_f, need_i
        return ARENA_FULL
    if most + 2 * choices > room.scratch:
        control[NEED_I] = most + 2 * choices
        return SCRATCH_FULL
    if control[STACK_TOP] + 2 > room.stack:
        return STACK_FULL
    polygons, corners = choices, choices * (most + 2 * choices)
    if counts[0] + polygons > room.polygons or counts[1] + corners > room.corners or counts[2] + corners > room.points:
        control[NEED_POLYGONS], control[NEED_CORNERS] = polygons, corners
        return OUTPUT_FULL
    return DONE


@kernel
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


@kernel
def how_to_fold(N, system, linear, dead):
    """UNSTABLE to fold all settled rows of the system, LINEAR to leave out the dead ones, DEAD to keep it as it is.

    Substitution costs the number of settled units times the square of all, whenever it is done, so it is done early,
    for more cells to share; and every folding costs a copy, the square of the number of units. Leaving out dead rows
    keeps the zeros between layers that are not neighbours.
    """
    units = N[system + SYS_UNITS]
    if units < SMALL_SYSTEM:
        return UNSTABLE if 3 * (linear + dead) >= units else DEAD
    if 12 * linear >= units:
        return UNSTABLE
    return LINEAR if 7 * dead >= units else DEAD


@kernel
def is_deep(N, control, system):
    """Whether errors are tracked in some cells of this system."""
    return N[system + SYS_LEVELS] >= control[TRACKED_LEVELS] and N[system + SYS_UNITS] >= control[TRACKED_UNITS]


@kernel
def how_to_bound(N, control, cell, system, large):
    """TRACKED for bounds from every unit's own error, SUMMED for sums of errors, FIRST_LEVEL for affine rows only."""
    if not is_deep(N, control, system):
        return SUMMED
    if N[cell + CELL_SINCE] % TRACKED_DEPTHS == 0:
        return TRACKED
    return FIRST_LEVEL if large else SUMMED


@kernel
def is_worth_tracking_again(N, control, system, folded):
    """Whether a cell that has been trimmed or shaved is bounded again, with its folded system, before it is split."""
    return is_deep(N, control, folded) and N[folded + SYS_UNITS] <= TRACKED_AGAIN * N[system + SYS_UNITS]


@kernel
def is_leaf(N, J, M, control, system):
    """Whether the rows have so few states left that all of the cell is emitted at once."""
    return count_choices(N, J, M, system, control[LEAF_CHOICES]) <= control[LEAF_CHOICES]


@kernel
def load_states(N, J, M, cell, rows):
    """Put the states of a cell's rows into J, where bounds narrow them."""
    states = cell + CELL_HEADER
    for r in range(rows):
        J[STATE_LOW * M + r] = N[states + r]
        J[STATE_HIGH * M + r] = N[states + rows + r]


# Inlined before LLVM sees it: as a function of its own, all that it calls would be optimised once more.
@inlined_kernel
def visit(F, N, X, J, M, control, stack, output, tables, S, K, slot_of_tag, cell):
    """Process one cell that has been taken off the stack."""
    floats, system = N[cell + CELL_SYSTEM_F], N[cell + CELL_SYSTEM_I]
    rows = N[system + SYS_ROWS]
    load_states(N, J, M, cell, rows)
    large = N[system + SYS_UNITS] >= control[LARGE_UNITS]
    how = how_to_bound(N, control, cell, system, large)
    if how == FIRST_LEVEL:
        bound_first_level(F, N, X, J, M, tables, cell, system, floats)
        row, knot = choose_split(N, X, J, M, tables, system)
        if row >= 0:
            split_cell(F, N, X, J, M, control, stack, tables, slot_of_tag, cell, rows, system, floats, row, row, knot)
            return
    # What is left of the cell is written while the table of errors is still needed.
    scratch = aligned(control[TOP_F] + parts_floats(N[cell + CELL_VERTICES]))
    linear, dead, bounded, radius = bound_units(
        F, N, X, J, M, tables, cell, system, floats, scratch, how != SUMMED, large
    )
    tracked = radius >= 0.0
    leaf = is_leaf(N, J, M, control, system)
    whole = cell
    loose = changed = False
    if bounded:
        low, high, slack = bound_output(F, N, X, M, tables.extent, cell, system, floats, radius)
        if low > slack or high < -slack:
            control[PRUNED] += 1
            return
        loose = min(high, slack) - max(low, -slack) > LOOSE_SHARE * (high - low)
        if not leaf:
            share = SHAVED_TRIMMED_SHARE if tracked else TRIMMED_SHARE
            cell = trim_cell(F, N, X, J, M, control, tables, slot_of_tag, cell, rows, low, high, slack, share)
    if cell != whole:
        changed = True
        control[TRIMMED] += 1
        newly_linear, newly_dead = settle_again(F, N, X, J, M, tables, cell, system, floats)
        linear += newly_linear
        dead += newly_dead
        leaf = is_leaf(N, J, M, control, system)
    if tracked and loose and not leaf:
        most = most_vertices(N[whole + CELL_VERTICES], np.int64(2))
        part, settled = shave_cell(
            F, N, X, J, M, S, K, control, tables, slot_of_tag, cell, rows, system, floats, scratch, most
        )
        if part == NO_SURFACE:
            control[PRUNED] += 1
            return
        if part != cell or settled > 0:
            changed = True
            if part != cell:
                control[SHAVED] += 1
                cell, rows = part, STATELESS
            newly_linear, newly_dead = settle_again(F, N, X, J, M, tables, cell, system, floats)
            linear += newly_linear
            dead += newly_dead
            leaf = is_leaf(N, J, M, control, system)
    row, knot = -1, 0
    if not leaf:
        row, knot = choose_split(N, X, J, M, tables, system)
    form = row
    folded, folded_floats = system, floats
    least = UNSTABLE if leaf else how_to_fold(N, system, linear, dead)
    if least > DEAD:
        folded, folded_floats = control[TOP_I], aligned(control[TOP_F])
        fold(F, N, X, J, M, system, floats, folded, folded_floats, least)
        carry_states(N, J, M, tables, system, folded, least)
        control[TOP_F] = folded_floats + N[folded + SYS_FLOATS]
        control[TOP_I] = folded + N[folded + SYS_INTS]
        control[FOLDS] += 1
        if row >= 0:
            row = new_row(J, M, row)
    if leaf:
        control[LEAVES] += 1
        control[BROKEN_CUTS] += emit_leaf(F, N, X, J, M, output, tables, slot_of_tag, cell, rows, folded, folded_floats)
        return
    if tracked and changed and is_worth_tracking_again(N, control, system, folded):
        push_trimmed(F, N, J, M, control, stack, cell, rows, folded, folded_floats, np.int64(0))
    elif row >= 0:
        split_cell(
            F, N, X, J, M, control, stack, tables, slot_of_tag, cell, rows, folded, folded_floats, row, form, knot
        )
    elif changed:  # none of the affine rows has a knot in it any more
        since = N[cell + CELL_SINCE] + 1
        push_trimmed(F, N, J, M, control, stack, cell, rows, folded, folded_floats, since)
    else:
        control[BROKEN_CUTS] += 1  # only if the network is not finite here: the first unstable row is affine


@njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
def march(worker, tables, output, budget):
    """Visit cells until the worker's stack is empty; returns one of the status codes of this module.

    ``worker``: `WorkerArrays`; ``tables``: `Tables`; ``output``: `OutputArrays`; ``budget``: about
    how many weights to read, or work that takes as long, before returning BUDGET_USED, as it does when it is ASKED.
    """
    M = worker.X.size // X_REGIONS
    F, N, X, J = pointer(worker.F), pointer(worker.N), pointer(worker.X), pointer(worker.J)
    S, K = pointer(worker.slice_floats), pointer(worker.slice_integers)
    control, stack, slot_of_tag = pointer(worker.control), pointer(worker.stack), pointer(worker.slot_of_tag)
    knots = point_at_tables(tables)
    buffers = point_at_output(output)
    sizes = output.sizes.size, output.corners.size, output.positions.shape[0]
    room = Room(worker.F.size, worker.N.size, M, worker.stack.size, *sizes)
    used = 0
    while control[STACK_TOP] > control[STACK_BOTTOM]:
        if control[STOP] != 0:
            return STOPPED
        if used > budget or control[ASKED] != 0:
            control[ASKED] = 0
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
        used += CELL_WORK + rows * cols
        before = cycles()
        visit(F, N, X, J, M, control, stack, buffers, knots, S, K, slot_of_tag, cell)
        bin_ = 0
        units = N[system + SYS_UNITS]
        while units > 0 and bin_ < PROFILE_BINS - 1:
            bin_ += 1
            units >>= 1
        layers = min(levels, PROFILE_BINS - 1)
        spent = cycles() - before
        control[PROFILE + bin_] += 1
        control[PROFILE + PROFILE_BINS + bin_] += spent
        control[PROFILE + 2 * PROFILE_BINS + layers] += 1
        control[PROFILE + 3 * PROFILE_BINS + layers] += spent
    return DONE
