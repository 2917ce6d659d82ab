"""Where things lie in the flat arrays that the kernels share.

A worker owns two arenas, ``F`` (float64) and ``N`` (int64), which grow upwards like a stack, and two scratch arrays,
``X`` (float64) and ``J`` (int64), cut into regions of ``M`` entries. Three kinds of blocks lie in the arenas.

*System*: the network restricted to a cell and all cells inside it. ``rows`` units, padded level by level to a multiple
of four, in large systems and the first one of eight, ``cols`` outputs of these units, and the hash of the states of
all units folded away.

    N: the SYS_* header, level_start[levels + 1], row_unit[rows] (-1 where padded),
       row_col[rows + 1], col_row[cols], col_begin[cols], col_end[cols] (the rows a column has weights on: whole
       levels, the same for all columns of a level, and never fewer than for those of a level before)
    F: affine parts a0[rows], a1[rows], a2[rows], a3[rows] (constant); of units with one knot and one output
       knot[rows], left slope[rows], left intercept[rows], right slope[rows], right intercept[rows] (the knot is NaN for
       other units, anything else where padded); weights[cols][rows] (anything before col_begin and
       from col_end on), output weights[cols], output affine part[4]

*Cell*: a simple convex polytope and its state ranges for the rows of its system.

    N: the CELL_* header, state_low[rows], state_high[rows], tags[3 * vertices], neighbours[3 * vertices]
    F: x[capacity], y[capacity], z[capacity], padded with copies of the last vertex

A vertex lies on three planes, listed counter-clockwise seen from outside; ``neighbours[3 * v + i]`` is the other end of
the edge that lies on the two planes other than ``i``. A plane's *tag* is twice its index, plus one when the cell is on
its upper side; box faces come after the knots and have even tags only. Then come the tags of the planes that cells were
trimmed by, two for every depth up to `TRIMMED_DEPTHS`: the surface never reaches those.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.kernel import kernel

SYS_ROWS, SYS_COLS, SYS_LEVELS, SYS_FLOATS, SYS_INTS, SYS_UNITS, SYS_HASH = 0, 1, 2, 3, 4, 5, 6
SYS_SINGLE, SYS_HEADER = 8, 9  # 1 if every unit of the network has one output

CELL_SYSTEM_F, CELL_SYSTEM_I, CELL_VERTICES, CELL_CAPACITY, CELL_FLOATS = 0, 1, 2, 3, 4
# CELL_SINCE: splits since the root, or since a cell was pushed to be tracked again (`march`).
CELL_END_F, CELL_END_I, CELL_DEPTH, CELL_SINCE, CELL_HEADER = 5, 6, 7, 8, 9

# Scratch regions of X. CENTRE takes four (the affine coefficients of every row), POLY_A and POLY_B three, FORMS four.
(CENTRE, RADIUS, LOW, HIGH, SLOPE, OFFSET, ERROR, OUT_COEF) = (0, 4, 5, 6, 7, 8, 9, 10)
(POLY_VALUES, CUT_X, CUT_Y, CUT_Z, CENTRE_AT, FORMS) = (19, 20, 21, 22, 23, 24)
OUTPUTS = 28  # five
GROWTH, SETTLED_SLOPE = 33, 34
CHOSEN = 35  # four
READ_SLOPE, READ_RADIUS, SYMBOL_ERROR, REACH = 39, 40, 41, 42
SYMBOL_SLOPE, SYMBOL_OFFSET, SYMBOL_RADIUS = 43, 44, 45
X_REGIONS = 46
# In X[CENTRE_AT], after the output's linear centre, where errors are tracked: the most that rounding can have taken off
# a row's errors, as a share of X[GROWTH], and off the output's, as it is.
ROUNDING_SHARE, OUTPUT_ROUNDING = 4, 5
# Kernels are called with these. numba compiles a kernel once more for every constant among its arguments, except for
# numpy's: so their numbers are numpy's, as are the constants in the kernels' calls of each other.
VALUES, OUT_VALUES, POLY_A, POLY_B = np.int64(11), np.int64(12), np.int64(13), np.int64(16)

# Scratch regions of J.
(STATE_LOW, STATE_HIGH, NEW_INDEX, CUT_OUT, CUT_IN, CUT_NEXT, CUT_PREVIOUS, CUT_FROM) = (0, 1, 2, 3, 4, 5, 6, 7)
TAGS_A, TAGS_B = np.int64(8), np.int64(9)  # kernels are called with them
(CUT_TO, KEPT_ROWS, STABLE_COLS, CHOICE, CHOICE_FIRST, CHOICE_LAST) = (10, 11, 12, 13, 14, 15)
(READ_COLS, READ_AT, KIND, BELOW, ABOVE, SIDE_COUNTS) = (16, 17, 18, 19, 20, 21)
(LEVEL_OUTPUT, LEVEL_SYMBOL, READ_ROW) = (22, 23, 24)
(KEPT, PLACE, OLD_COL, SETTLED_ROW, COL_KIND) = (25, 26, 27, 28, 29)
SINCE, UNTIL = np.int64(30), np.int64(31)
READ_SYMBOL, SYMBOL_OUTPUT, LIVE, LIVE_AT, LIVE_ROWS, LEVEL_ROW = 32, 33, 34, 35, 36, 37
SYMBOL_ROW, SYMBOL_AT = 38, 39
J_REGIONS = 40

# What F has for every row of a system, apart from the weights: the affine part, and the two pieces around its knot.
PIECE_FLOATS = 5
ROW_FLOATS = 4 + PIECE_FLOATS

# Kinds of rows: settled with output zero, settled, neither.
DEAD, LINEAR, UNSTABLE = 0, 1, 2


# Cells deeper than this are not trimmed.
TRIMMED_DEPTHS = 1024


@kernel
def padded(count: int) -> int:
    """``count`` rounded up to a multiple of the lane width."""
    return (count + 3) & ~3


@kernel
def aligned(place: int) -> int:
    """``place`` rounded up to where a line of the machine's caches begins: wide loads across two lines take twice."""
    return (place + 7) & ~7


@kernel
def knots_of(floats: int, rows: int) -> int:
    """Where in F the table of knots of a system of so many rows begins."""
    return floats + 4 * rows


@kernel
def weights_of(floats: int, rows: int) -> int:
    """Where in F the weights of a system of so many rows begin."""
    return floats + ROW_FLOATS * rows


@kernel
def system_ints(rows: int, cols: int, levels: int) -> int:
    """Number of int64 a system takes."""
    return SYS_HEADER + levels + 1 + 2 * rows + 1 + 3 * cols


@kernel
def system_floats(rows: int, cols: int) -> int:
    """Number of float64 a system takes, padded to the lane width."""
    return ROW_FLOATS * rows + cols * rows + padded(cols) + 4


@kernel
def cell_ints(rows: int, vertices: int) -> int:
    """Number of int64 a cell takes."""
    return CELL_HEADER + 2 * rows + 6 * vertices


@kernel
def symbol_stride(cols: int) -> int:
    """Room, in float32, for the error symbols of a system: at most one a column, padded to the tiles of products.

    An odd number of cache lines: with many a power of two, rows of the same symbol would compete for one place.
    """
    return (cols + 31) & ~31 | 16


@kernel
def first_trim_tag(n_knots: int) -> int:
    """The tags of planes that trimmed a cell start here, after the knots and six box faces."""
    return 2 * (n_knots + 6)
