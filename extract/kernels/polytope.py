"""Simple convex polytopes: split by a plane, cut into a polygon, clip that polygon.

Combinatorial throughout: which edges are cut follows from the signs at the vertices alone, zero counting as positive,
and the order of the corners from the order of the planes around a vertex. At a vertex with planes (a, b, c),
counter-clockwise seen from outside, the boundary of face ``a`` comes in along plane ``b`` and leaves along ``c``; the
two ends of an edge on planes (b, c) list these two in opposite order.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.kernels.lanes import fma, lane, larger, load, load_wide, smaller, splat, splat_wide, store
from mn_onnx.extract.kernels.masks import (
    at_least,
    bits_of,
    both,
    choose,
    count_before,
    count_bits,
    count_up,
    is_below,
    pack_store,
    same,
    splat_integer,
    without,
)
from mn_onnx.extract.kernels.memory import (
    ABOVE,
    BELOW,
    CELL_CAPACITY,
    CELL_FLOATS,
    CELL_HEADER,
    CELL_VERTICES,
    CUT_FROM,
    CUT_IN,
    CUT_NEXT,
    CUT_OUT,
    CUT_PREVIOUS,
    CUT_TO,
    CUT_X,
    NEW_INDEX,
    POLY_VALUES,
    SIDE_COUNTS,
    padded,
)
from mn_onnx.ir.kernel import kernel

TINY = 1e-300


@kernel
def most_vertices(vertices, cuts):
    """Upper bound of the vertices of a part of a simple polytope that is cut so often.

    A cut has at most one vertex a face, and a simple polytope half as many faces as vertices, and two.
    """
    for _ in range(cuts):
        vertices += (vertices >> 1) + 2
    return vertices


@kernel
def evaluate_affine(F, N, X, M, cell, region, a0, a1, a2, a3):
    """``X[region]`` = a . x + a3 at the cell's vertices (and at its padding, which repeats the last one)."""
    x = N[cell + CELL_FLOATS]
    capacity = N[cell + CELL_CAPACITY]
    b0, b1, b2, b3 = splat(a0), splat(a1), splat(a2), splat(a3)
    out = region * M
    for v in range(0, capacity, 4):
        value = fma(b0, load(F, x + v), fma(b1, load(F, x + capacity + v), fma(b2, load(F, x + 2 * capacity + v), b3)))
        store(X, out + v, value)


@kernel
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


@kernel
def find_cut_edges(F, N, X, J, M, cell, rows, values):
    """Collect the edges on which ``X[values]`` changes sign, from the negative to the positive end.

    Fills CUT_FROM and CUT_TO (``3 * vertex + slot`` at either end), the corner's position CUT_X, CUT_Y, CUT_Z, and the
    tags CUT_IN, CUT_OUT along which the polygon of the cut comes in and leaves, seen from the positive side. BELOW and
    ABOVE list the vertices of either sign, SIDE_COUNTS their numbers, and NEW_INDEX gives a vertex's place in its list.
    Returns the number of edges.
    """
    n = N[cell + CELL_VERTICES]
    tags = cell + CELL_HEADER + 2 * rows
    neighbours = tags + 3 * n
    x = N[cell + CELL_FLOATS]
    capacity = N[cell + CELL_CAPACITY]
    t = values * M
    below, above = np.int64(0), np.int64(0)
    for v in range(0, n, 8):
        inside = is_below(count_up(v), splat_integer(n))
        negative = both(inside, is_below(load_wide(X, t + v), splat_wide(0.0)))
        others = without(inside, negative)
        pack_store(J, BELOW * M + below, count_up(v), negative)
        pack_store(J, ABOVE * M + above, count_up(v), others)
        places = count_before(bits_of(negative), below), count_before(bits_of(others), above)
        store(J, NEW_INDEX * M + v, choose(negative, places[0], places[1]))
        below += count_bits(bits_of(negative))
        above += count_bits(bits_of(others))
    J[SIDE_COUNTS * M] = below
    J[SIDE_COUNTS * M + 1] = above
    count = 0
    for b in range(below):
        v3 = 3 * J[BELOW * M + b]
        for i in range(3):
            J[CUT_FROM * M + count] = v3 + i
            count += X[t + N[neighbours + v3 + i]] >= 0.0
    for j in range(count):
        end = J[CUT_FROM * M + j]
        v = end // 3
        i = end - 3 * v
        u = N[neighbours + end]
        back = (N[neighbours + 3 * u + 1] == v) + 2 * (N[neighbours + 3 * u + 2] == v)
        k1 = i + 1 if i < 2 else 0
        k2 = i - 1 if i > 0 else 2
        tv = X[t + v]
        s = tv / (tv - X[t + u])
        J[CUT_TO * M + j] = 3 * u + back
        J[CUT_OUT * M + j] = N[tags + 3 * v + k1]
        J[CUT_IN * M + j] = N[tags + 3 * v + k2]
        for axis in range(3):
            at = x + axis * capacity
            X[(CUT_X + axis) * M + j] = F[at + v] + s * (F[at + u] - F[at + v])
    return count


@kernel
def link_cut_edges(J, M, slot_of_tag, count):
    """Order the corners of a cut: CUT_NEXT and CUT_PREVIOUS. ``slot_of_tag`` is scratch of one entry per tag.

    Returns whether the cut is one polygon (or nothing). It is, unless rounding has decided the signs at vertices that
    nearly coincide as no plane could: then the links are of no use.
    """
    for j in range(count):
        slot_of_tag[J[CUT_IN * M + j]] = j
    for j in range(count):
        following = slot_of_tag[J[CUT_OUT * M + j]]
        J[CUT_NEXT * M + j] = following
        J[CUT_PREVIOUS * M + following] = j
    j, met = 0, 0
    while met < count and 0 <= j < count:
        j = J[CUT_NEXT * M + j]
        met += 1
        if j == 0:
            break
    return count == 0 or (j == 0 and met == count and count >= 3)


@kernel
def write_half(F, N, X, J, M, cell, rows, half_rows, count, side, tag, half, half_floats):
    """Write one half of the polytope that `find_cut_edges` has looked at.

    The caller fills the rest of the header and the states. ``side`` 0 keeps the negative vertices, 1 the others.
    ``half`` and ``half_floats`` are its places in N and F, ``rows`` and ``half_rows`` the rows of the cell's and the
    half's systems. Returns the number of vertices.
    """
    n = N[cell + CELL_VERTICES]
    tags = cell + CELL_HEADER + 2 * rows
    neighbours = tags + 3 * n
    x = N[cell + CELL_FLOATS]
    capacity = N[cell + CELL_CAPACITY]
    members = (BELOW if side == 0 else ABOVE) * M
    kept = J[SIDE_COUNTS * M + side]
    total = kept + count
    new_capacity = padded(total)
    new_tags = half + CELL_HEADER + 2 * half_rows
    new_neighbours = new_tags + 3 * total
    N[half + CELL_VERTICES] = total
    N[half + CELL_CAPACITY] = new_capacity
    N[half + CELL_FLOATS] = half_floats
    for w in range(kept):
        v = J[members + w]
        for axis in range(3):
            F[half_floats + axis * new_capacity + w] = F[x + axis * capacity + v]
        for i in range(3):
            N[new_tags + 3 * w + i] = N[tags + 3 * v + i]
            # An edge that is cut has its far end on the other side; that entry is set below.
            N[new_neighbours + 3 * w + i] = J[NEW_INDEX * M + N[neighbours + 3 * v + i]]
    near = (CUT_FROM if side == 0 else CUT_TO) * M
    for j in range(count):
        w = kept + j
        for axis in range(3):
            F[half_floats + axis * new_capacity + w] = X[(CUT_X + axis) * M + j]
        end = J[near + j]
        v = end // 3
        i = end - 3 * v
        N[new_neighbours + 3 * J[NEW_INDEX * M + v] + i] = w
        incoming, outgoing = J[CUT_IN * M + j], J[CUT_OUT * M + j]
        following, previous = kept + J[CUT_NEXT * M + j], kept + J[CUT_PREVIOUS * M + j]
        N[new_tags + 3 * w] = tag
        N[new_neighbours + 3 * w] = J[NEW_INDEX * M + v]
        if side == 0:
            N[new_tags + 3 * w + 1] = incoming
            N[new_tags + 3 * w + 2] = outgoing
            N[new_neighbours + 3 * w + 1] = following
            N[new_neighbours + 3 * w + 2] = previous
        else:
            N[new_tags + 3 * w + 1] = outgoing
            N[new_tags + 3 * w + 2] = incoming
            N[new_neighbours + 3 * w + 1] = previous
            N[new_neighbours + 3 * w + 2] = following
    for axis in range(3):
        at = half_floats + axis * new_capacity
        for w in range(total, new_capacity):
            F[at + w] = F[at + total - 1]
    return total


@kernel
def read_cut_polygon(X, J, M, count, polygon, tags):
    """Copy a linked cut to a polygon: corners in ``X[polygon : polygon + 3]``, the tag of each edge in ``J[tags]``."""
    j = 0
    for corner in range(count):
        for axis in range(3):
            X[(polygon + axis) * M + corner] = X[(CUT_X + axis) * M + j]
        J[tags * M + corner] = J[CUT_OUT * M + j]
        j = J[CUT_NEXT * M + j]


@kernel
def count_corners_inside(X, M, count, polygon, a0, a1, a2, a3, side, gradient):
    """How many corners of a polygon lie where a . x + a3, in X[POLY_VALUES], is negative (side 0) or not (side 1).

    A corner exactly on the plane goes to the side where f (``X[gradient : gradient + 3]``) falls: the piece on the
    other side has no point with f < 0 there.
    """
    rises = a0 * X[gradient] + a1 * X[gradient + 1] + a2 * X[gradient + 2] > 0.0
    on_plane = splat_wide(-TINY if rises else 0.0)
    b0, b1, b2, b3, zero = splat_wide(a0), splat_wide(a1), splat_wide(a2), splat_wide(a3), splat_wide(0.0)
    at = polygon * M
    inside = 0
    for j in range(0, count, 8):
        z = load_wide(X, at + 2 * M + j)
        value = fma(b0, load_wide(X, at + j), fma(b1, load_wide(X, at + M + j), fma(b2, z, b3)))
        value = choose(same(value, zero), on_plane, value)
        store(X, POLY_VALUES * M + j, value)
        above = at_least(value, zero)
        corner = is_below(count_up(j), splat_integer(count))
        inside += count_bits(bits_of(both(corner, above) if side == 1 else without(corner, above)))
    return inside


@kernel
def clip_polygon(X, J, M, count, polygon, tags, result, result_tags, side, tag):
    """Keep the part of a convex polygon on one side of the plane that `count_corners_inside` has looked at.

    The new edge gets ``tag``. Returns the number of corners of the result.
    """
    px, py, pz = polygon * M, (polygon + 1) * M, (polygon + 2) * M
    values = POLY_VALUES * M
    out = 0
    rx, ry, rz = result * M, (result + 1) * M, (result + 2) * M
    for j in range(count):
        k = j + 1 if j + 1 < count else 0
        here, there = X[values + j], X[values + k]
        here_in, there_in = (here >= 0.0) == (side == 1), (there >= 0.0) == (side == 1)
        if here_in:
            X[rx + out], X[ry + out], X[rz + out] = X[px + j], X[py + j], X[pz + j]
            J[result_tags * M + out] = J[tags * M + j]
            out += 1
        if here_in != there_in:
            # From the negative end, so that both sides of the plane get the same point.
            a, b, ta, tb = (j, k, here, there) if here < 0.0 else (k, j, there, here)
            s = ta / (ta - tb)
            X[rx + out] = X[px + a] + s * (X[px + b] - X[px + a])
            X[ry + out] = X[py + a] + s * (X[py + b] - X[py + a])
            X[rz + out] = X[pz + a] + s * (X[pz + b] - X[pz + a])
            J[result_tags * M + out] = tag if here_in else J[tags * M + j]
            out += 1
    return out


@kernel
def copy_polytope(F, N, cell, rows, new_rows, copy, copy_floats):
    """Write a cell's polytope again at ``copy`` (N) and ``copy_floats`` (F), for a system of ``new_rows`` rows.

    The caller fills the rest of the header and the states. Returns the number of vertices.
    """
    n, capacity, x = N[cell + CELL_VERTICES], N[cell + CELL_CAPACITY], N[cell + CELL_FLOATS]
    N[copy + CELL_VERTICES], N[copy + CELL_CAPACITY], N[copy + CELL_FLOATS] = n, capacity, copy_floats
    for v in range(3 * capacity):
        F[copy_floats + v] = F[x + v]
    source, target = cell + CELL_HEADER + 2 * rows, copy + CELL_HEADER + 2 * new_rows
    for i in range(6 * n):
        N[target + i] = N[source + i]
    return n
