"""Clean-up of a closed mesh some of whose vertices coincide: the mesh that the same polygons have as point sets.

Where the topology of the point set differs from that of the mesh, as where a thin tube becomes a point, the polygons
around a vertex that do not form one ring or fan get a vertex each, so that the result is a manifold again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype, resolve_threads
from mn_onnx.extract.components import connected_roots
from mn_onnx.extract.degeneracy.linked_mesh import LinkedMesh, as_surface, link_in_polygons
from mn_onnx.extract.degeneracy.walks import Walks
from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.measures import measure_polygons
from mn_onnx.extract.surface import Surface

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Contraction:
    """What a contraction did: ``merged_vertices`` that took another's place and ``removed_polygons`` without area."""

    merged_vertices: int
    removed_polygons: int


def contract_short_edges(surface: Surface, length: float) -> tuple[Surface, Contraction]:
    """Make the ends of every edge of at most ``length`` one vertex and remove the polygons that have no area then.

    A polygon has no area if it is at most ``length`` wide; one that borders on itself stays. Polygons on both sides of
    a removed one are joined. Merged vertices stand where the first of them stood. The order of the remaining polygons
    does not change, vertices are numbered by their first corner.
    """
    total = Contraction(0, 0)
    while True:
        surface, step = _contract_once(surface, length)
        total = Contraction(
            total.merged_vertices + step.merged_vertices, total.removed_polygons + step.removed_polygons
        )
        # A removed polygon may leave an edge between vertices that coincide but had none before.
        if not step.removed_polygons:
            return surface, total


def _contract_once(surface: Surface, length: float) -> tuple[Surface, Contraction]:
    heads = half_edge_heads(surface.offsets, surface.corners)
    steps = surface.vertices[heads] - surface.vertices[surface.corners]
    short = np.einsum("ij,ij->i", steps, steps) <= length * length
    merged_into = connected_roots(surface.corners[short], heads[short], surface.n_vertices)
    mesh = _contracted(surface, merged_into, heads)
    flat = _flat_polygons(surface, mesh, length)
    mesh = _zipped(_without(mesh, flat, surface.vertices))
    result = as_surface(surface, mesh)
    n_merged = int(np.count_nonzero(merged_into != np.arange(surface.n_vertices)))
    return result, Contraction(n_merged, surface.n_polygons - result.n_polygons)


def _contracted(surface: Surface, merged_into: Indices, heads: Indices) -> LinkedMesh:
    """The mesh with merged vertices and without the edges that have become loops."""
    tails = merged_into[surface.corners]
    alive = tails != merged_into[heads]
    kept = np.flatnonzero(alive)
    numbers = np.cumsum(alive, dtype=surface.twins.dtype) - 1
    twins = surface.twins[kept]
    polygons = np.repeat(np.arange(surface.n_polygons, dtype=index_dtype(surface.n_polygons)), surface.polygon_sizes)
    polygons = polygons[kept]
    following, preceding = link_in_polygons(polygons)
    return LinkedMesh(
        tails[kept],
        following,
        preceding,
        np.where(twins >= 0, numbers[twins], -1).astype(twins.dtype),
        polygons,
        surface.box_faces[kept],
    )


def _flat_polygons(surface: Surface, mesh: LinkedMesh, width: float) -> Indices:
    """The first half-edge of every polygon that is at most ``width`` wide."""
    starts = np.flatnonzero(np.diff(mesh.polygons, prepend=-1))
    offsets = np.append(starts, mesh.polygons.size)
    measures = measure_polygons(surface.vertices, offsets, mesh.tails, resolve_threads(None))
    return starts[measures.areas <= width * measures.perimeters]


def _without(mesh: LinkedMesh, flat: Indices, positions: Floats) -> LinkedMesh:
    """The mesh without the polygons of the half-edges ``flat``, but for those that border on themselves."""
    if not flat.size:
        return mesh
    walks = Walks(mesh.tails, mesh.following, mesh.preceding, mesh.twins, mesh.polygons, mesh.box_faces)
    for start in flat.tolist():
        walks.flatten(start, positions)
    order: list[int] = []
    seen = np.full(mesh.polygons.max() + 1, False)
    for half_edge, polygon in enumerate(mesh.polygons.tolist()):
        if not seen[polygon] and walks.following[half_edge] >= 0:
            seen[polygon] = True
            order.extend(walks.outline(half_edge))
    dtype = index_dtype(len(walks.tails))
    numbers = np.full(len(walks.tails) + 1, -1, dtype)  # one more: that of the missing twin, -1
    numbers[order] = np.arange(len(order))
    polygons = np.array(walks.polygons, mesh.polygons.dtype)[order]
    following, preceding = link_in_polygons(polygons)
    return LinkedMesh(
        np.array(walks.tails, mesh.tails.dtype)[order],
        following,
        preceding,
        numbers[np.array(walks.twins, dtype)[order]],
        polygons,
        np.array(walks.box_faces, np.int8)[order],
    )


def _zipped(mesh: LinkedMesh) -> LinkedMesh:
    """The mesh with half-edges joined that have no twin and run along the same edge in opposite directions.

    Such pairs arise where a slit in the surface, cut by the box, has lost its width.
    """
    open_edges = np.flatnonzero(mesh.twins < 0)
    tails, heads = mesh.tails[open_edges], mesh.tails[mesh.following[open_edges]]
    ends = np.stack([np.minimum(tails, heads), np.maximum(tails, heads)], axis=1)
    _, edges, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edges.reshape(-1), kind="stable")
    firsts = (np.cumsum(uses) - uses)[uses == 2]
    one, other = order[firsts], order[firsts + 1]
    opposite = (tails[one] == heads[other]) & (mesh.polygons[open_edges[one]] != mesh.polygons[open_edges[other]])
    one, other = open_edges[one[opposite]], open_edges[other[opposite]]
    twins, box_faces = mesh.twins.copy(), mesh.box_faces.copy()
    twins[one], twins[other] = other, one
    box_faces[one] = box_faces[other] = -1
    return replace(mesh, twins=twins, box_faces=box_faces)
