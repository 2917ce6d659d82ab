"""Divides polygons of a surface around a new vertex in their middle, with no gap to those that stay whole.

A divided polygon gets edges from the middles of its long edges to its centre. A neighbour that is not divided gets the
middle of the common edge as one more corner, so that all edges still join two polygons.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype
from mn_onnx.extract.edges import half_edge_heads, pair_half_edges
from mn_onnx.extract.smooth.faces import mean_over_corners
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

LONG = 0.5
"""Edges of at least this part of the longest one are halved; the two longest always are."""


@threaded_kernel
def _mark_spokes(
    vertices: Floats, offsets: Integers, corners: Indices, twins: Indices, chosen: Integers, halved: Booleans
) -> None:
    """Mark the long half-edges of the polygons ``chosen``, and their twins."""
    for polygon in chosen:
        begin, end = offsets[polygon], offsets[polygon + 1]
        longest = second = 0.0
        lengths = np.empty(end - begin)
        for corner in range(begin, end):
            head = corners[corner + 1] if corner + 1 < end else corners[begin]
            square = 0.0
            for axis in range(3):
                square += (vertices[head, axis] - vertices[corners[corner], axis]) ** 2
            lengths[corner - begin] = square
            if square > longest:
                longest, second = square, longest
            elif square > second:
                second = square
        least = min(LONG * LONG * longest, second)
        for corner in range(begin, end):
            if lengths[corner - begin] >= least:
                halved[corner] = True
                if twins[corner] >= 0:
                    halved[twins[corner]] = True


@threaded_kernel
def _count(offsets: Integers, spokes: Booleans, halved: Booleans, divided: Booleans) -> tuple[int, int]:
    """The numbers of polygons and corners of the divided surface."""
    polygons = total = 0
    for polygon in range(offsets.size - 1):
        arms = 0
        for corner in range(offsets[polygon], offsets[polygon + 1]):
            total += 2 if halved[corner] else 1
            arms += spokes[corner]
        polygons += arms if divided[polygon] else 1
        # Each arm's middle is a corner of two parts, and the centre one of every part.
        total += 2 * arms if divided[polygon] else 0
    return polygons, total


@threaded_kernel
def _fill(
    offsets: Integers,
    corners: Indices,
    box_faces: NDArray[np.int8],
    spokes: Booleans,
    middles: Integers,
    centres: Integers,
    new_offsets: Integers,
    new_corners: Indices,
    new_box_faces: NDArray[np.int8],
    parents: Integers,
) -> None:
    """The polygons of the divided surface. ``middles`` [c], ``centres`` [p]: the new vertices there, or -1."""
    polygon_out = corner_out = 0
    for polygon in range(offsets.size - 1):
        begin, end = offsets[polygon], offsets[polygon + 1]
        start = begin
        if centres[polygon] >= 0:
            while not spokes[start]:
                start += 1
        opened = corner_out
        for step in range(end - begin):
            corner = start + step
            if corner >= end:
                corner -= end - begin
            if centres[polygon] >= 0 and spokes[corner]:
                if step > 0:
                    # The part so far ends at this middle, and returns to its own first one by the centre.
                    new_corners[corner_out], new_box_faces[corner_out] = corners[corner], box_faces[corner]
                    new_corners[corner_out + 1], new_box_faces[corner_out + 1] = middles[corner], -1
                    new_corners[corner_out + 2], new_box_faces[corner_out + 2] = centres[polygon], -1
                    corner_out += 3
                    new_offsets[polygon_out], parents[polygon_out] = opened, polygon
                    polygon_out += 1
                    opened = corner_out
                new_corners[corner_out], new_box_faces[corner_out] = middles[corner], box_faces[corner]
                corner_out += 1
                continue
            new_corners[corner_out], new_box_faces[corner_out] = corners[corner], box_faces[corner]
            corner_out += 1
            if middles[corner] >= 0:
                new_corners[corner_out], new_box_faces[corner_out] = middles[corner], box_faces[corner]
                corner_out += 1
        if centres[polygon] >= 0:
            new_corners[corner_out], new_box_faces[corner_out] = corners[start], box_faces[start]
            new_corners[corner_out + 1], new_box_faces[corner_out + 1] = middles[start], -1
            new_corners[corner_out + 2], new_box_faces[corner_out + 2] = centres[polygon], -1
            corner_out += 3
        new_offsets[polygon_out], parents[polygon_out] = opened, polygon
        polygon_out += 1
    new_offsets[polygon_out] = corner_out


@dataclass(frozen=True, eq=False)
class Division:
    """What `subdivide` gives.

    ``order``: int64 [v], vertex ``i`` of ``surface`` was vertex ``order[i]``, or is new from the number of old vertices
    on. By rising ``i`` for these: ``free``, bool [new, 3], the axes along which they may move; ``carried``, [new, k],
    the means of what their edges' or polygons' corners carry; ``centre_of``, int64 [new], the polygon that each is the
    centre of, or -1. ``parents``: int64 [p], the polygons that those of ``surface`` are parts of; ``whole``: bool [p],
    whether they still have the same corners.
    """

    surface: Surface
    order: Integers
    free: Booleans
    carried: Floats
    centre_of: Integers
    parents: Integers
    whole: Booleans


def subdivide(surface: Surface, chosen: Integers, free: Booleans, carried: Floats, threads: int) -> Division:
    """Divide the polygons ``chosen`` (int64 [n]) of ``surface``; no vertex moves.

    ``free``: bool [v, 3], the axes along which vertices may move. ``carried``: float64 [v, k], what else vertices
    carry. Attributes and errors of polygons are those of the parents.
    """
    chosen = np.sort(chosen)
    divided = np.zeros(surface.n_polygons, bool)
    divided[chosen] = True
    halved = np.zeros(surface.n_corners, bool)
    _mark_spokes(surface.vertices, surface.offsets, surface.corners, surface.twins, chosen, halved)
    # A divided polygon has an arm to every middle on its border, also to those that its neighbours ask for.
    spokes = halved & np.repeat(divided, surface.polygon_sizes)
    heads = half_edge_heads(surface.offsets, surface.corners)
    first_side = np.flatnonzero(halved & ((surface.twins < 0) | (surface.twins > np.arange(surface.n_corners))))
    n_old = surface.n_vertices
    middles = np.full(surface.n_corners, -1, np.int64)
    middles[first_side] = n_old + np.arange(first_side.size)
    paired = first_side[surface.twins[first_side] >= 0]
    middles[surface.twins[paired]] = middles[paired]
    centres = np.full(surface.n_polygons, -1, np.int64)
    centres[divided] = n_old + first_side.size + np.arange(chosen.size)
    tails, ends = surface.corners[first_side], heads[first_side]

    def of_new_vertices(of_vertices: Floats) -> Floats:
        at_centres = mean_over_corners(of_vertices, surface.offsets, surface.corners, chosen)
        return np.concatenate([0.5 * (of_vertices[tails] + of_vertices[ends]), at_centres])

    vertices = np.concatenate([surface.vertices, of_new_vertices(surface.vertices)])
    on_box = surface.box_faces[first_side] >= 0
    free_middles = np.ones((first_side.size, 3), bool)
    free_middles[on_box] = free[tails[on_box]] | free[ends[on_box]]
    free_middles[np.flatnonzero(on_box), surface.box_faces[first_side[on_box]] // 2] = False

    n_polygons, n_corners = _count(surface.offsets, spokes, halved, divided)
    dtype = index_dtype(max(n_corners, len(vertices)))
    offsets, parents = np.empty(n_polygons + 1, np.int64), np.empty(n_polygons, np.int64)
    corners, box_faces = np.empty(n_corners, dtype), np.empty(n_corners, np.int8)
    _fill(
        surface.offsets, surface.corners, surface.box_faces, spokes, middles, centres,
        offsets, corners, box_faces, parents,
    )  # fmt: skip
    order, corners = _by_first_corner(corners, len(vertices))
    result = replace(
        surface,
        vertices=vertices[order],
        offsets=offsets,
        corners=corners,
        twins=pair_half_edges(offsets, corners, len(vertices), threads),
        box_faces=box_faces,
        gradients=surface.gradients[parents],
        errors=surface.errors[parents],
        attributes={name: values[parents] for name, values in surface.attributes.items()},
    )
    new = order[order >= n_old] - n_old
    whole = ~(np.logical_or.reduceat(halved, surface.offsets[:-1]) | divided)
    return Division(
        surface=result,
        order=order,
        free=np.concatenate([free_middles, np.ones((chosen.size, 3), bool)])[new],
        carried=of_new_vertices(carried)[new],
        centre_of=np.concatenate([np.full(first_side.size, -1), chosen])[new],
        parents=parents,
        whole=whole[parents],
    )


def _by_first_corner(corners: Indices, n_vertices: int) -> tuple[Integers, Indices]:
    """Vertices by their first corner, int64 [v], and ``corners`` numbered so."""
    first = np.empty(n_vertices, np.int64)
    first[corners[::-1]] = np.arange(corners.size - 1, -1, -1)
    order = np.argsort(first, kind="stable")
    rank = np.empty(n_vertices, corners.dtype)
    rank[order] = np.arange(n_vertices)
    return order, rank[corners]
