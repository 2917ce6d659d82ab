"""A polygon mesh as linked half-edges, and the collapse of one edge in it."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype
from mn_onnx.extract.edges import preceding_corners


class HalfEdges(NamedTuple):
    """Half-edges of a mesh that is being changed, one per corner [c], and tallies of what they belong to.

    A half-edge leaves the vertex ``tails``, belongs to the polygon ``polygons`` and stands between ``preceding`` and
    ``following`` in it; a removed one has ``following`` -1. ``twins`` and ``box_faces`` as in `Surface`.
    ``sizes``: the half-edges of each polygon [p]. ``valences``: the polygons at each vertex [v]. ``seen_vertices`` [v]
    and ``seen_polygons`` [p] hold the stamp of the latest collapse that met them.
    """

    tails: Indices
    following: Indices
    preceding: Indices
    twins: Indices
    polygons: Indices
    box_faces: NDArray[np.int8]
    sizes: NDArray[np.int64]
    valences: NDArray[np.int64]
    seen_vertices: NDArray[np.int64]
    seen_polygons: NDArray[np.int64]


def link_half_edges(
    offsets: NDArray[np.int64], corners: Indices, twins: Indices, box_faces: NDArray[np.int8], n_vertices: int
) -> HalfEdges:
    """Linked half-edges of the mesh; the arguments are not changed by what is done with them."""
    sizes = np.diff(offsets)
    n_polygons = sizes.size
    preceding = preceding_corners(offsets)
    following = np.empty_like(preceding)
    following[preceding] = np.arange(preceding.size)
    return HalfEdges(
        tails=corners.copy(),
        following=following,
        preceding=preceding,
        twins=twins.copy(),
        polygons=np.repeat(np.arange(n_polygons, dtype=index_dtype(n_polygons)), sizes),
        box_faces=box_faces.copy(),
        sizes=sizes,
        valences=np.bincount(corners, minlength=n_vertices),
        seen_vertices=np.zeros(n_vertices, np.int64),
        seen_polygons=np.zeros(n_polygons, np.int64),
    )


@numba.njit(cache=True)
def _first_around(mesh: HalfEdges, start: int) -> int:
    """The half-edge at which a turn around the tail of ``start`` begins: one without twin if there is any."""
    half_edge = start
    while mesh.twins[half_edge] >= 0:
        half_edge = mesh.following[mesh.twins[half_edge]]
        if half_edge == start:
            break
    return half_edge


@numba.njit(cache=True)
def _box_constraint(mesh: HalfEdges, half_edge: int) -> int:
    """How the tail of ``half_edge`` is held: 0 inside, 1 within one box face or open edge, 2 between two."""
    outgoing = _first_around(mesh, half_edge)
    if mesh.twins[outgoing] >= 0:
        return 0
    last = outgoing
    while mesh.twins[mesh.preceding[last]] >= 0:
        last = mesh.twins[mesh.preceding[last]]
    return 1 if mesh.box_faces[outgoing] == mesh.box_faces[mesh.preceding[last]] else 2


@numba.njit(cache=True)
def _link_condition_holds(mesh: HalfEdges, at_kept: int, at_dropped: int, n_shared: int, stamp: int) -> bool:
    """Whether the tails of two half-edges may become one vertex.

    The link condition (Dey et al., "Topology preserving edge contraction", 1999) for polygons: the vertices share no
    polygon but the ``n_shared`` at their edge, and no neighbour but the tips of triangles there.
    """
    first = _first_around(mesh, at_kept)
    half_edge = first
    n_around = 0
    while True:
        n_around += 1
        mesh.seen_vertices[mesh.tails[mesh.following[half_edge]]] = stamp
        mesh.seen_vertices[mesh.tails[mesh.preceding[half_edge]]] = stamp
        mesh.seen_polygons[mesh.polygons[half_edge]] = stamp
        half_edge = mesh.twins[mesh.preceding[half_edge]]
        if half_edge < 0 or half_edge == first:
            break
    if n_around != mesh.valences[mesh.tails[at_kept]]:
        return False

    first = _first_around(mesh, at_dropped)
    half_edge = first
    n_around = n_polygons = n_neighbours = n_triangles = 0
    while True:
        n_around += 1
        if mesh.seen_polygons[mesh.polygons[half_edge]] == stamp:
            n_polygons += 1
            n_triangles += mesh.sizes[mesh.polygons[half_edge]] == 3
        n_neighbours += mesh.seen_vertices[mesh.tails[mesh.following[half_edge]]] == stamp
        before = mesh.preceding[half_edge]
        half_edge = mesh.twins[before]
        if half_edge < 0:
            n_neighbours += mesh.seen_vertices[mesh.tails[before]] == stamp
        if half_edge < 0 or half_edge == first:
            break
    return n_around == mesh.valences[mesh.tails[at_dropped]] and n_polygons == n_shared and n_neighbours == n_triangles


@numba.njit(cache=True)
def _may_shrink(mesh: HalfEdges, half_edge: int) -> bool:
    """Whether the polygon of ``half_edge`` may lose it: beside a triangle, two different polygons must remain."""
    if mesh.sizes[mesh.polygons[half_edge]] > 3:
        return True
    one, other = mesh.twins[mesh.following[half_edge]], mesh.twins[mesh.preceding[half_edge]]
    if one < 0 or other < 0:
        return bool(one >= 0 or other >= 0)
    return bool(mesh.polygons[one] != mesh.polygons[other])


@numba.njit(cache=True)
def _remove_from_polygon(mesh: HalfEdges, half_edge: int) -> None:
    """Take ``half_edge`` out of its polygon; if only two are left the polygon goes, and their twins are joined."""
    after, before = mesh.following[half_edge], mesh.preceding[half_edge]
    polygon = mesh.polygons[half_edge]
    mesh.following[before] = after
    mesh.preceding[after] = before
    mesh.following[half_edge] = -1
    mesh.valences[mesh.tails[half_edge]] -= 1
    mesh.sizes[polygon] -= 1
    if mesh.sizes[polygon] > 2:
        return
    one, other = mesh.twins[after], mesh.twins[before]
    if one >= 0:
        mesh.twins[one] = other
        if other < 0:
            mesh.box_faces[one] = mesh.box_faces[before]
    if other >= 0:
        mesh.twins[other] = one
        if one < 0:
            mesh.box_faces[other] = mesh.box_faces[after]
    for left in (after, before):
        mesh.following[left] = -1
        mesh.valences[mesh.tails[left]] -= 1
    mesh.sizes[polygon] = 0


@numba.njit(cache=True)
def _collapse(mesh: HalfEdges, half_edge: int, merged_into: Indices, stamp: int) -> bool:
    """Collapse the edge of ``half_edge`` if that keeps the topology; the end that is held more by the box stays."""
    twin = mesh.twins[half_edge]
    at_kept, at_dropped = half_edge, mesh.following[half_edge]
    held_kept, held_dropped = _box_constraint(mesh, at_kept), _box_constraint(mesh, at_dropped)
    if held_dropped > held_kept or (held_dropped == held_kept and mesh.tails[at_dropped] < mesh.tails[at_kept]):
        at_kept, at_dropped = at_dropped, at_kept
        held_kept, held_dropped = held_dropped, held_kept
    if held_dropped > (0 if twin >= 0 else 1) or not _may_shrink(mesh, half_edge):
        return False
    n_shared = 1
    if twin >= 0:
        n_shared = 2
        if not _may_shrink(mesh, twin):
            return False
    kept, dropped = mesh.tails[at_kept], mesh.tails[at_dropped]
    n_vanishing = int(mesh.sizes[mesh.polygons[half_edge]] == 3)
    if twin >= 0:
        n_vanishing += int(mesh.sizes[mesh.polygons[twin]] == 3)
    if held_kept == 0 and mesh.valences[kept] + mesh.valences[dropped] - n_shared - n_vanishing < 3:
        return False
    if not _link_condition_holds(mesh, at_kept, at_dropped, n_shared, stamp):
        return False

    first = _first_around(mesh, at_dropped)
    turning = first
    while True:
        mesh.tails[turning] = kept
        turning = mesh.twins[mesh.preceding[turning]]
        if turning < 0 or turning == first:
            break
    mesh.valences[kept] += mesh.valences[dropped]
    mesh.valences[dropped] = 0
    merged_into[dropped] = kept
    _remove_from_polygon(mesh, half_edge)
    if twin >= 0:
        _remove_from_polygon(mesh, twin)
    return True


@numba.njit(cache=True)
def collapse_pass(
    mesh: HalfEdges, vertices: NDArray[np.float64], length: float, merged_into: Indices, stamp: int
) -> tuple[int, int]:
    """Collapse edges of at most ``length`` in the order of their half-edges, each if that keeps the topology.

    ``merged_into`` [v] receives the vertex that took a vertex's place. ``stamp`` exceeds all earlier stamps by at least
    the number of half-edges. Returns how many edges were collapsed and how many were refused.
    """
    n_collapsed = n_refused = 0
    for half_edge in range(mesh.tails.size):
        if mesh.following[half_edge] < 0 or 0 <= mesh.twins[half_edge] < half_edge:
            continue
        tail, head = mesh.tails[half_edge], mesh.tails[mesh.following[half_edge]]
        squared = 0.0
        for axis in range(3):
            squared += (vertices[tail, axis] - vertices[head, axis]) ** 2
        if squared > length * length:
            continue
        if tail != head and _collapse(mesh, half_edge, merged_into, stamp + half_edge):
            n_collapsed += 1
        else:
            n_refused += 1
    return n_collapsed, n_refused
