"""Shaving: slices at either end of a cell are cut off if bounds on each slice alone prove that the surface misses it.

Bounds get tighter with the size of what they are for, and faster so than linearly in deep networks, where the range of
a unit grows by the widths of all levels before. So thin slices of a cell can be dropped that no bound on the whole cell
excludes. What the errors tracked for the cell tell of its slices costs a fraction of tracking them (`slices`). The idea
is that of constraint programming (3B consistency: Lhomme, Consistency Techniques for Numeric CSPs, IJCAI 1993). The
slices lie along the planes where the output's linear centre is constant, as those of `trim_cell` do.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.error_symbols import table_at
from mn_onnx.extract.kernels.masks import lowest_bit
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_DEPTH,
    CENTRE_AT,
    OUT_VALUES,
    SIDE_COUNTS,
    SYS_COLS,
    SYS_ROWS,
    TRIMMED_DEPTHS,
    VALUES,
    first_trim_tag,
)
from mn_onnx.extract.kernels.polytope import (
    evaluate_affine,
    find_cut_edges,
    link_cut_edges,
    value_range,
)
from mn_onnx.extract.kernels.slice_points import ALL_SLICES, SLICES, place_points, plane_value
from mn_onnx.extract.kernels.slices import keep_states, missed_slices
from mn_onnx.extract.kernels.split import THINNEST, write_part
from mn_onnx.ir.kernel import kernel

# Only cells of which the surface may be in at least this share, in terms of the output's range; of others the bounds
# are tight already. Measured: 0.4 and 0.6 do equally well.
LOOSE_SHARE = 0.4
# Rows of a polytope without states, and the sides of a plane: numpy's, see `memory`.
STATELESS, LOWER, UPPER = np.int64(0), np.int64(0), np.int64(1)
# What `shave_cell` returns instead of a cell.
NO_SURFACE = -1


@kernel
def cut_off(F, N, X, J, M, control, slot_of_tag, cell, rows, limit, kept_side, tag, most):
    """The part of the cell on one side of the plane where the output's centre is ``limit``, without states.

    ``kept_side`` is LOWER or UPPER; ``rows`` are those of the cell's states. Returns the part and the rows of its
    states: the cell itself if it is too degenerate to be cut, or the part would have over ``most`` vertices.
    """
    at = CENTRE_AT * M
    evaluate_affine(F, N, X, M, cell, VALUES, X[at], X[at + 1], X[at + 2], X[at + 3] - limit)
    count = find_cut_edges(F, N, X, J, M, cell, rows, VALUES)
    if count == 0 or J[SIDE_COUNTS * M + kept_side] + count > most or not link_cut_edges(J, M, slot_of_tag, count):
        return cell, rows
    part = write_part(F, N, X, J, M, control, cell, rows, STATELESS, count, kept_side, tag + kept_side)
    return part, STATELESS


@kernel
def shave_cell(F, N, X, J, M, S, K, control, tables, slot_of_tag, cell, rows, system, floats, scratch, most):
    """The cell without the slices at either end that the surface misses; NO_SURFACE if it misses all of them.

    That is a polytope without states, or the cell itself if nothing goes. The errors tracked for the cell, or for one
    that it is part of, are still in F[scratch] (`bound_units`). States of the system's rows, in J, are narrowed to
    those of the slices that stay; returns also how many are settled by that. ``rows``: those of the cell's states;
    ``most``: how many vertices a part may have. ``S``, ``K``: scratch, see `slice_points`.
    """
    at = CENTRE_AT * M
    evaluate_affine(F, N, X, M, cell, OUT_VALUES, X[at], X[at + 1], X[at + 2], X[at + 3])
    low, high = value_range(X, M, OUT_VALUES, N[cell + CELL_CAPACITY])
    size = abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]) + abs(X[at + 3])
    thickness = (high - low) / SLICES
    depth = N[cell + CELL_DEPTH]
    if depth >= TRIMMED_DEPTHS or thickness < THINNEST * size * tables.extent:
        return cell, 0
    if not place_points(F, N, X, S, K, M, cell, rows, low, thickness):
        return cell, 0
    errors, own, stride = table_at(scratch, N[system + SYS_ROWS], N[system + SYS_COLS])
    kept = missed_slices(F, N, X, S, J, K, M, tables, system, floats, errors, stride, own) ^ ALL_SLICES
    if kept == 0:
        return NO_SURFACE, 0
    tag = first_trim_tag(tables.n_knots) + 2 * depth
    top, bottom = SLICES, lowest_bit(kept)
    while kept >> (top - 1) == 0:
        top -= 1
    if top < SLICES:
        limit = plane_value(low, thickness, top)
        part, rows = cut_off(F, N, X, J, M, control, slot_of_tag, cell, rows, limit, LOWER, tag, most)
        top = top if part != cell else SLICES
        cell = part
    if bottom > 0:
        limit = plane_value(low, thickness, bottom)
        part, rows = cut_off(F, N, X, J, M, control, slot_of_tag, cell, rows, limit, UPPER, tag, most)
        bottom = bottom if part != cell else 0
        cell = part
    # Also slices between others that the surface misses stay in the cell.
    return cell, keep_states(N, J, K, M, system, (1 << top) - (1 << bottom))
