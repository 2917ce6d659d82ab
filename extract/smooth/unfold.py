"""Turns back the faces of a mesh that a projection onto a smooth surface has turned over.

Vertices around such a face slide along the surface, each to the mean of its neighbours: a convex combination map, whose
solution over a convex border has no fold in the plane (Tutte 1963; Floater, Mathematics of Computation 72, 2003). Where
a few sweeps on a small patch do not do, the patch grows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.edges import corners_by_vertex, half_edge_heads
from mn_onnx.extract.smooth.faces import facing
from mn_onnx.extract.smooth.projection import Projection
from mn_onnx.extract.surface import Surface

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ROUNDS = 24
ROUNDS_PER_RING = 4
"""So often a patch of some rings of vertices around the faces is tried before it grows by one ring."""

RETREATS = 12
"""Vertices of faces that stay turned over go half the way back this often, then all the way."""

SWEEPS = 8
DAMPING = 0.7


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Who is next to whom on a mesh. ``order``, ``starts``: `corners_by_vertex`; ``heads``: `half_edge_heads`."""

    offsets: NDArray[np.int64]
    corners: Indices
    heads: Indices
    order: Indices
    starts: Integers

    @classmethod
    def of(cls, surface: Surface, threads: int) -> Neighbours:
        order, starts = corners_by_vertex(surface.corners, surface.n_vertices, threads)
        heads = half_edge_heads(surface.offsets, surface.corners)
        return cls(surface.offsets, surface.corners, heads, order, starts)

    def corners_at(self, vertices: Integers) -> Integers:
        """The corners at ``vertices``, vertex by vertex."""
        return self.order[_ranges(self.starts[vertices], self.starts[vertices + 1])].astype(np.int64)

    def polygons_at(self, vertices: Integers) -> Integers:
        """The polygons with a corner at any of ``vertices``, ascending."""
        return np.unique(np.searchsorted(self.offsets, self.corners_at(vertices), side="right") - 1)

    def vertices_of(self, polygons: Integers) -> Integers:
        """The vertices of ``polygons``, ascending."""
        return np.unique(self.corners[_ranges(self.offsets[polygons], self.offsets[polygons + 1])]).astype(np.int64)

    def facing(self, polygons: Integers, positions: Floats, gradients: Floats) -> Floats:
        """`facing` of ``polygons``."""
        return facing(positions, gradients, self.offsets, self.corners, polygons)


def _ranges(begins: Integers, ends: Integers) -> Integers:
    """The integers of all ranges ``begins[i] .. ends[i] - 1``, one range after another."""
    sizes = ends - begins
    shifts = begins - (np.cumsum(sizes) - sizes)
    return np.asarray(np.arange(int(sizes.sum()), dtype=np.int64) + np.repeat(shifts, sizes))


def unfold(
    neighbours: Neighbours,
    folded: Integers,
    positions: Floats,
    gradients: Floats,
    movable: NDArray[np.bool_],
    project: Callable[[Integers], None],
) -> tuple[Integers, Integers]:
    """Slide vertices until none of the polygons ``folded`` is turned over; returns those that still are, and who slid.

    ``positions``, ``gradients``: [v, 3], changed in place. ``movable``: bool [v]. ``project(vertices)`` brings
    ``vertices`` back onto the surface and their gradients up to date.
    """
    slid: list[Integers] = []
    for attempt in range(ROUNDS):
        if not folded.size:
            break
        patch = neighbours.vertices_of(folded)
        for _ in range(attempt // ROUNDS_PER_RING):
            patch = neighbours.vertices_of(neighbours.polygons_at(patch))
        patch = patch[movable[patch]]
        if not patch.size:
            break
        _smooth(neighbours, patch, positions, gradients)
        project(patch)
        slid.append(patch)
        touched = np.union1d(neighbours.polygons_at(patch), folded)
        folded = touched[neighbours.facing(touched, positions, gradients) < 0]
    return folded, np.unique(np.concatenate([np.zeros(0, np.int64), *slid]))


def _smooth(neighbours: Neighbours, patch: Integers, positions: Floats, gradients: Floats) -> None:
    """Move the vertices of ``patch`` towards the means of their neighbours, within their tangent planes."""
    corners = neighbours.corners_at(patch)
    heads = neighbours.heads[corners]
    own = np.repeat(np.arange(patch.size), neighbours.starts[patch + 1] - neighbours.starts[patch])
    valences = np.bincount(own, minlength=patch.size)
    lengths = np.sqrt((gradients[patch] ** 2).sum(axis=1))
    normals = gradients[patch] / np.where(lengths > 0, lengths, 1.0)[:, None]
    for _ in range(SWEEPS):
        around = positions[heads]
        means = np.stack([np.bincount(own, around[:, axis], patch.size) for axis in range(3)], axis=1)
        moves = means / valences[:, None] - positions[patch]
        moves -= np.einsum("ij,ij->i", moves, normals)[:, None] * normals
        positions[patch] += DAMPING * moves


def turn_back(
    surface: Surface, projection: Projection, upright: NDArray[np.bool_], polygons: Integers, threads: int
) -> tuple[Integers, Integers]:
    """Turn back the faces that the projection turned over; returns the vertices that slid, and those held back.

    ``surface``: with the vertices where they were before. ``upright``: bool [p], the polygons that faced along the true
    gradient then; none of them stays turned over, save where that gradient was interpolated and is not the true one.
    ``polygons``: those with a vertex that was projected.
    """
    nobody = np.zeros(0, np.int64)
    folded = polygons[
        facing(projection.positions, projection.gradients, surface.offsets, surface.corners, polygons) < 0
    ]
    if not folded.size:
        return nobody, nobody
    neighbours = Neighbours.of(surface, threads)
    movable = np.asarray(projection.free.all(axis=1))

    def project(vertices: Integers) -> None:
        # Sliding along the surface may have led out of the box.
        slid = projection.positions[vertices]
        projection.positions[vertices] = np.clip(slid, projection.lower, projection.upper)
        projection.evaluate(vertices)
        projection.project(vertices)

    folded, slid = unfold(neighbours, folded, projection.positions, projection.gradients, movable, project)
    folded = folded[upright[folded]]
    goals = projection.positions.copy()
    shares = np.ones(surface.n_vertices)
    retreats = 0
    while folded.size:
        back = neighbours.vertices_of(folded)
        back = back[shares[back] > 0]
        if not back.size:
            break
        shares[back] *= 0.5 if retreats < RETREATS else 0.0
        retreats += 1
        start = surface.vertices[back]
        projection.positions[back] = start + shares[back, None] * (goals[back] - start)
        projection.evaluate(back)
        touched = neighbours.polygons_at(back)
        touched = touched[upright[touched]]
        folded = touched[neighbours.facing(touched, projection.positions, projection.gradients) < 0]
    held = np.flatnonzero(shares < 1.0)
    projection.held[held] = True
    return slid, held
