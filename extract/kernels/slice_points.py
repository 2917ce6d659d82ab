"""Slices of a cell: where their vertices are, and ranges of affine forms over them.

Also where things lie in the scratch of what is done for eight slices at once, see `slices`: S (float64) and K (int64),
cut into regions of multiples of ``M`` entries as X and J are (`memory`).
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import fma, larger, load_wide, smaller, splat_wide, store
from mn_onnx.extract.kernels.masks import at_least, bits_of, count_bits
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_FLOATS,
    CELL_HEADER,
    CELL_VERTICES,
    CENTRE_AT,
)
from mn_onnx.ir.kernel import kernel

SLICES, ALL_SLICES = 8, 0xFF  # one to a lane; as bits

# Regions of the scratch S, in multiples of M. For every symbol, in float32, the five vectors of its affine form and
# radius, and the output's derivative by its row; slope, offset and error of its chord; the lists of points; of every
# vertex how far it is above each plane; the forms of four rows, or eight products; the chords of one unit; the middle
# of the cell and half of its extent along each axis, and the largest that any symbol can be by its form.
SYMBOLS, DERIVATIVES, PIECES, POINTS, PLANE_VALUES, FORMS, RELAXED, MIDDLE = 0, 20, 24, 48, 88, 96, 97, 98
MOST = 8  # after S[MIDDLE]
SLICE_FLOATS = 99
# Regions of the scratch K: of every symbol the slices in which its unit is settled, as bits; the slice of every vertex;
# the numbers of points.
ABOVE, UNDER, SLICE_OF, POINT_COUNTS = 0, 1, 2, 3
SLICE_INTEGERS = 4
# Numbers in the vectors of a point, of a chord, and of a symbol or a form.
POINT, PIECE, FORM = 3 * SLICES, 3 * SLICES, 5 * SLICES


@kernel
def plane_value(low, thickness, k):
    """The value of the output's centre on plane ``k``, the lower one of slice ``k``."""
    return low + k * thickness


@kernel
def find_slices(F, N, X, S, K, M, cell, low, thickness):
    """K[SLICE_OF] of the cell's vertices, and in S[PLANE_VALUES] how far each is above the planes.

    Numbers are those of `evaluate_affine`, to the last bit, so that slices end where a cut of the cell does.
    """
    n, x, capacity = N[cell + CELL_VERTICES], N[cell + CELL_FLOATS], N[cell + CELL_CAPACITY]
    centre = CENTRE_AT * M
    b0, b1, b2 = splat_wide(X[centre]), splat_wide(X[centre + 1]), splat_wide(X[centre + 2])
    for k in range(1, SLICES):
        S[FORMS * M + k] = X[centre + 3] - plane_value(low, thickness, k)
    S[FORMS * M] = np.inf  # every vertex is above the first plane
    b3 = load_wide(S, FORMS * M)
    for v in range(n):
        x0, x1 = splat_wide(F[x + v]), splat_wide(F[x + capacity + v])
        value = fma(b0, x0, fma(b1, x1, fma(b2, splat_wide(F[x + 2 * capacity + v]), b3)))
        store(S, PLANE_VALUES * M + SLICES * v, value)
        K[SLICE_OF * M + v] = max(count_bits(bits_of(at_least(value, splat_wide(0.0)))) - 1, 0)


@kernel
def find_middle(F, N, S, M, cell):
    """S[MIDDLE]: the middle of the cell's bounding box (three numbers), and half of its size."""
    n, capacity = N[cell + CELL_VERTICES], N[cell + CELL_CAPACITY]
    for axis in range(3):
        x = N[cell + CELL_FLOATS] + axis * capacity
        low = high = F[x]
        for v in range(1, n):
            low, high = min(low, F[x + v]), max(high, F[x + v])
        S[MIDDLE * M + axis] = 0.5 * low + 0.5 * high
        S[MIDDLE * M + 3 + axis] = 0.5 * high - 0.5 * low


@kernel
def place_points(F, N, X, S, K, M, cell, rows, low, thickness):
    """The vertices of all slices: lane ``k`` of S[POINTS] lists those of slice ``k``.

    The lists are equally long, the first of K[POINT_COUNTS], by copies of a point. Also S[MIDDLE]. ``low``: the least
    value of the centre, X[CENTRE_AT], on the cell. Returns whether all slices have points, and there is room for them.
    """
    n, x, capacity = N[cell + CELL_VERTICES], N[cell + CELL_FLOATS], N[cell + CELL_CAPACITY]
    neighbours = cell + CELL_HEADER + 2 * rows + 3 * n
    slice_of, counts = SLICE_OF * M, POINT_COUNTS * M
    # At most all vertices, and a corner of either plane on every edge.
    if 4 * n * POINT > (PLANE_VALUES - POINTS) * M:
        return False
    find_slices(F, N, X, S, K, M, cell, low, thickness)
    find_middle(F, N, S, M, cell)
    for k in range(SLICES):
        K[counts + k] = 0
    for v in range(n):
        place_point(S, K, M, K[slice_of + v], F[x + v], F[x + capacity + v], F[x + 2 * capacity + v])
        for i in range(3):
            u = N[neighbours + 3 * v + i]
            for k in range(K[slice_of + v] + 1, K[slice_of + u] + 1):
                here, there = S[PLANE_VALUES * M + SLICES * v + k], S[PLANE_VALUES * M + SLICES * u + k]
                share = here / (here - there)
                y0 = F[x + v] + share * (F[x + u] - F[x + v])
                y1 = F[x + capacity + v] + share * (F[x + capacity + u] - F[x + capacity + v])
                y2 = F[x + 2 * capacity + v] + share * (F[x + 2 * capacity + u] - F[x + 2 * capacity + v])
                place_point(S, K, M, k - 1, y0, y1, y2)
                place_point(S, K, M, k, y0, y1, y2)
    least = most = K[counts]
    for k in range(1, SLICES):
        least, most = min(least, K[counts + k]), max(most, K[counts + k])
    for k in range(SLICES):
        at = POINTS * M + k
        for _ in range(K[counts + k], most):
            place_point(S, K, M, k, S[at], S[at + SLICES], S[at + 2 * SLICES])
    return least > 0


@kernel
def place_point(S, K, M, k, x, y, z):
    """Append a point to the list of slice ``k``."""
    at = POINTS * M + POINT * K[POINT_COUNTS * M + k] + k
    S[at], S[at + SLICES], S[at + 2 * SLICES] = x, y, z
    K[POINT_COUNTS * M + k] += 1


@kernel
def value_ranges(S, K, M, c0, c1, c2, c3):
    """Smallest and largest value of an affine form for each slice, over that slice."""
    p = POINTS * M
    low = fma(c0, load_wide(S, p), fma(c1, load_wide(S, p + 8), fma(c2, load_wide(S, p + 16), c3)))
    high = low
    for _ in range(1, K[POINT_COUNTS * M]):
        p += POINT
        value = fma(c0, load_wide(S, p), fma(c1, load_wide(S, p + 8), fma(c2, load_wide(S, p + 16), c3)))
        low, high = smaller(value, low), larger(value, high)
    return low, high
