"""Shaving: slices are cut off a cell as long as bounds on the slice alone prove that the surface misses it.

Bounds get tighter with the size of what they are for, and faster so than linearly in deep networks, where the range of
a unit grows by the widths of all levels before. So thin slices of a cell can be dropped that no bound on the whole cell
excludes. The idea is that of constraint programming (3B consistency: Lhomme, Consistency Techniques for Numeric CSPs,
IJCAI 1993). The slices lie along the planes where the output's linear centre is constant, as those of `trim_cell` do.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mn_onnx.extract.kernels.bound import bound_output, bound_units
from mn_onnx.extract.kernels.control import SHAVED_LEVELS, SHAVED_UNITS, TOP_F, TOP_I
from mn_onnx.extract.kernels.lanes import store
from mn_onnx.extract.kernels.masks import load_integers
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_DEPTH,
    CENTRE_AT,
    OUT_VALUES,
    SIDE_COUNTS,
    STATE_HIGH,
    STATE_LOW,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_UNITS,
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
from mn_onnx.extract.kernels.split import THINNEST, write_part

# Only cells of which the surface may be in at least this share, in terms of the output's range; of others the bounds
# are tight already. Measured: without this share there is hardly a cell less, and 2 to 3 % more time.
LOOSE_SHARE = 0.4
# The first slice on either side is this share of the cell's thickness, and after one that had to stay each is this
# share of that. After so many that had to stay, the side is left as it is. Measured: first shares of 1/8 to 1/3, and
# two or three slices that stay, differ by some hundredths; after one that stays it is too early to stop.
SLICE_SHARE, SLICES_KEPT = 1.0 / 3.0, 2
# Slices tried on either side at most; what `shave_cell` takes of the arenas follows from it.
MOST_SLICES = 6
# Rows of a polytope without states; and slices are bounded neither by tracked errors nor as large cells. Both are
# numpy's, see `memory`.
STATELESS, NEITHER = np.int64(0), np.bool_(False)


@njit(cache=True, error_model="numpy")
def is_worth_shaving(N, control, system):
    """Whether slices of cells of this system are likely to save more than they cost."""
    return N[system + SYS_LEVELS] >= control[SHAVED_LEVELS] and N[system + SYS_UNITS] >= control[SHAVED_UNITS]


@njit(cache=True, error_model="numpy")
def misses_surface(F, N, J, M, trial_X, trial_J, control, tables, part, system, floats):
    """Whether the surface provably misses a polytope inside the cell whose states over ``system`` are in J."""
    for r in range(0, N[system + SYS_ROWS], 8):
        store(trial_J, STATE_LOW * M + r, load_integers(J, STATE_LOW * M + r))
        store(trial_J, STATE_HIGH * M + r, load_integers(J, STATE_HIGH * M + r))
    bound_units(F, N, trial_X, trial_J, M, tables, part, system, floats, control[TOP_F], NEITHER, NEITHER)
    low, high, slack = bound_output(F, N, trial_X, M, tables.extent, part, system, floats)
    return low > slack or high < -slack


@njit(cache=True, error_model="numpy")
def shave_cell(F, N, X, J, M, trial_X, trial_J, control, tables, slot_of_tag, cell, rows, system, floats, most):
    """The cell without slices that the surface misses, as a polytope without states; the cell itself if none does.

    ``rows``: those of the cell's own system, ``system`` the folded one, whose rows have their states in J. ``most``:
    how many vertices a part may have. Slices are bounded in ``trial_X`` and ``trial_J``, so X and J stay as they are
    apart from the regions of a cut.
    """
    at = CENTRE_AT * M
    evaluate_affine(F, N, X, M, cell, OUT_VALUES, X[at], X[at + 1], X[at + 2], X[at + 3])
    low, high = value_range(X, M, OUT_VALUES, N[cell + CELL_CAPACITY])
    size = abs(X[at]) + abs(X[at + 1]) + abs(X[at + 2]) + abs(X[at + 3])
    thinnest = THINNEST * size * tables.extent
    depth = N[cell + CELL_DEPTH]
    if depth >= TRIMMED_DEPTHS:
        return cell
    tag = first_trim_tag(tables.n_knots) + 2 * depth
    for kept_side in range(2):  # 0: slices off the top, where the centre is largest
        thickness = SLICE_SHARE * (high - low)
        kept = 0
        for _ in range(MOST_SLICES):
            if thickness < thinnest or high - low < 1.5 * thickness:
                break
            limit = high - thickness if kept_side == 0 else low + thickness
            evaluate_affine(F, N, X, M, cell, VALUES, X[at], X[at + 1], X[at + 2], X[at + 3] - limit)
            count = find_cut_edges(F, N, X, J, M, cell, rows, VALUES)
            if count == 0 or max(J[SIDE_COUNTS * M], J[SIDE_COUNTS * M + 1]) + count > most:
                break
            if not link_cut_edges(J, M, slot_of_tag, count):
                break
            top_f, top_i = control[TOP_F], control[TOP_I]
            part = write_part(F, N, X, J, M, control, cell, rows, STATELESS, count, 1 - kept_side, tag + 1 - kept_side)
            misses = misses_surface(F, N, J, M, trial_X, trial_J, control, tables, part, system, floats)
            control[TOP_F], control[TOP_I] = top_f, top_i
            if misses:
                cell = write_part(F, N, X, J, M, control, cell, rows, STATELESS, count, kept_side, tag + kept_side)
                rows = STATELESS
                if kept_side == 0:
                    high = limit
                else:
                    low = limit
                continue
            kept += 1
            if kept == SLICES_KEPT:
                break
            thickness *= SLICE_SHARE
    return cell
