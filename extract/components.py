"""Connected components of a polygon mesh, and the measures of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.measures import PolygonMeasures
from mn_onnx.ir.kernel import threaded_kernel


@dataclass(frozen=True)
class Component:
    """A part of the surface that is connected through shared vertices.

    ``volume`` is what it encloses: negative for the wall of a cavity, None where the component is not closed.
    ``genus`` is None where the component is not a manifold.
    """

    polygons: int
    vertices: int
    edges: int
    boundary_loops: int
    closed: bool
    genus: int | None
    area: float
    volume: float | None

    @property
    def euler(self) -> int:
        """Vertices - edges + polygons."""
        return self.vertices - self.edges + self.polygons


@threaded_kernel
def _find_root(parents: Indices, vertex: int) -> int:
    while parents[vertex] != vertex:
        parents[vertex] = parents[parents[vertex]]
        vertex = parents[vertex]
    return vertex


@threaded_kernel
def _connect(tails: Indices, heads: Indices, parents: Indices) -> None:
    """Make the smallest connected vertex the parent of every vertex."""
    for edge in range(tails.size):
        a = _find_root(parents, tails[edge])
        b = _find_root(parents, heads[edge])
        if a < b:
            parents[b] = a
        else:
            parents[a] = b
    for vertex in range(parents.size):
        parents[vertex] = _find_root(parents, vertex)


def connected_roots(tails: Indices, heads: Indices, n_vertices: int) -> Indices:
    """For each vertex the smallest vertex connected with it by the edges ``tails[i], heads[i]``."""
    parents = np.arange(n_vertices, dtype=tails.dtype)
    _connect(tails, heads, parents)
    return parents


def label_components(offsets: NDArray[np.int64], corners: Indices, n_vertices: int) -> tuple[Indices, Indices, int]:
    """The component of each polygon [p] and of each vertex [v] (-1: in no polygon), and the number of components.

    Components are numbered by their first polygon.
    """
    roots = connected_roots(corners, half_edge_heads(offsets, corners), n_vertices)
    polygon_roots = roots[corners[offsets[:-1]]]
    found, first_polygons = np.unique(polygon_roots, return_index=True)
    numbers = np.full(n_vertices, -1, roots.dtype)
    numbers[found[np.argsort(first_polygons)]] = np.arange(found.size)
    return numbers[polygon_roots], numbers[roots], found.size


def unpaired_edges(
    offsets: NDArray[np.int64], corners: Indices, twins: Indices
) -> tuple[NDArray[np.int64], Indices, Indices]:
    """The half-edges without a twin: their corners in ascending order, the vertices they leave and those they reach."""
    unpaired = np.flatnonzero(twins < 0)
    following = unpaired + 1
    ends = np.searchsorted(offsets, unpaired, side="right")
    following = np.where(following == offsets[ends], offsets[ends - 1], following)
    return unpaired, corners[unpaired], corners[following]


def find_components(
    offsets: NDArray[np.int64],
    corners: Indices,
    twins: Indices,
    manifold_vertices: NDArray[np.bool_],
    measures: PolygonMeasures,
) -> tuple[Component, ...]:
    """All components, in the order of their first polygons. ``manifold_vertices``: bool [v]."""
    n_vertices = manifold_vertices.size
    polygon_labels, vertex_labels, n = label_components(offsets, corners, n_vertices)
    if not n:
        return ()
    paired = np.add.reduceat(twins >= 0, offsets[:-1], dtype=np.int64)
    n_paired = np.bincount(polygon_labels, weights=paired, minlength=n).astype(np.int64)

    _, tails, heads = unpaired_edges(offsets, corners, twins)
    ends = np.sort(np.stack([tails, heads], axis=1), axis=1)
    open_edges, uses = np.unique(ends, axis=0, return_counts=True)
    open_labels = vertex_labels[open_edges[:, 0]]
    n_open = np.bincount(open_labels, minlength=n)
    boundary_roots = np.unique(connected_roots(tails, heads, n_vertices)[tails])
    n_loops = np.bincount(vertex_labels[boundary_roots], minlength=n)

    broken = np.zeros(n, np.bool_)
    broken[open_labels[uses > 1]] = True
    broken[vertex_labels[~manifold_vertices & (vertex_labels >= 0)]] = True
    n_polygons = np.bincount(polygon_labels, minlength=n)
    n_in_component = np.bincount(vertex_labels[vertex_labels >= 0], minlength=n)
    areas = np.bincount(polygon_labels, weights=measures.areas, minlength=n)
    volumes = np.bincount(polygon_labels, weights=measures.volumes, minlength=n)

    components = []
    for label in range(n):
        edges = int(n_paired[label] // 2 + n_open[label])
        euler = int(n_in_component[label]) - edges + int(n_polygons[label])
        closed = not n_open[label]
        components.append(
            Component(
                polygons=int(n_polygons[label]),
                vertices=int(n_in_component[label]),
                edges=edges,
                boundary_loops=int(n_loops[label]),
                closed=closed,
                genus=None if broken[label] else (2 - euler - int(n_loops[label])) // 2,
                area=float(areas[label]),
                volume=float(volumes[label]) if closed else None,
            )
        )
    return tuple(components)
