"""The result of an extraction: a welded mesh of convex polygons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mn_onnx.extract.blocks import Indices, index_dtype, resolve_threads
from mn_onnx.extract.components import Component, find_components, unpaired_edges
from mn_onnx.extract.edges import pair_half_edges
from mn_onnx.extract.measures import PolygonMeasures, lengths, measure_polygons
from mn_onnx.extract.tessellate import fan_triangles
from mn_onnx.extract.umbrellas import Umbrellas, find_umbrellas

if TYPE_CHECKING:
    import trimesh

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """``p`` convex polygons with ``c`` corners in all, on ``v`` shared vertices.

    ``vertices``: float64 [v, 3], numbered by their first corner.
    ``offsets``: int64 [p + 1]; polygon ``i`` owns corners ``offsets[i]:offsets[i + 1]``, counter-clockwise seen from
    the side where ``f`` is larger.
    ``corners``: int32 or int64 [c], the vertex of each corner.
    ``twins``: int32 or int64 [c]; the edge from this corner to the next one of its polygon is, in the neighbouring
    polygon, the edge from corner ``twins[c]``. -1 where there is no neighbour.
    ``box_faces``: int8 [c], the box face (2 * axis + side) on which this edge lies, -1 for an edge inside the box.
    ``gradients``: float64 [p, 3], the gradient of ``f`` on the polygon.
    ``errors``: float64 [p], a proved bound on ``|f_true|`` on the polygon; zero for exact networks.
    ``attributes``: further values per polygon, each [p] or [p, k], by name.
    ``report``: what the steps that made the surface have to tell, ready for JSON.
    """

    vertices: Floats
    offsets: NDArray[np.int64]
    corners: Indices
    twins: Indices
    box_faces: NDArray[np.int8]
    gradients: Floats
    errors: Floats
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    report: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_polygons(
        cls, vertices: ArrayLike, offsets: ArrayLike, corners: ArrayLike, *, threads: int | None = None
    ) -> Surface:
        """A surface from any indexed polygon mesh, such as one read from a file.

        ``vertices``: [v, 3]; ``offsets``: [p + 1]; ``corners``: [c] vertex indices. Edges are paired; the gradients
        are the unit normals of the polygons (zero for a polygon without area); no edge is taken to lie on the box.

        Raises ValueError where the arrays do not describe polygons of at least 3 corners.
        """
        points = np.ascontiguousarray(vertices, np.float64)
        bounds = np.ascontiguousarray(offsets, np.int64)
        indices = np.asarray(corners)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"vertices have shape {points.shape}, expected [v, 3]")
        if bounds.ndim != 1 or not bounds.size or bounds[0] != 0 or (np.diff(bounds) < 3).any():
            raise ValueError("offsets must start at 0 and rise by at least 3 for every polygon")
        if indices.shape != (bounds[-1],) or (indices.size and not np.issubdtype(indices.dtype, np.integer)):
            raise ValueError(f"corners are {indices.dtype}{list(indices.shape)}, expected {bounds[-1]} integers")
        if indices.size and (indices.min() < 0 or indices.max() >= len(points)):
            raise ValueError(
                f"corners run from {indices.min()} to {indices.max()}, but there are {len(points)} vertices"
            )
        threads = resolve_threads(threads)
        indices = np.ascontiguousarray(indices, index_dtype(len(points)))
        twins = pair_half_edges(bounds, indices, len(points), threads)
        measures = measure_polygons(points, bounds, indices, threads)
        return cls(
            vertices=points,
            offsets=bounds,
            corners=indices,
            twins=twins,
            box_faces=np.full(indices.size, -1, np.int8),
            gradients=unit_vectors(measures.area_vectors),
            errors=np.zeros(bounds.size - 1),
        )

    @property
    def n_vertices(self) -> int:
        return len(self.vertices)

    @property
    def n_polygons(self) -> int:
        return self.offsets.size - 1

    @property
    def n_corners(self) -> int:
        return self.corners.size

    @property
    def n_edges(self) -> int:
        """Pairs of half-edges, and distinct edges without a pair."""
        _, tails, heads = unpaired_edges(self.offsets, self.corners, self.twins)
        ends = np.stack([np.minimum(tails, heads), np.maximum(tails, heads)], axis=1)
        return (self.n_corners - tails.size) // 2 + len(np.unique(ends, axis=0))

    @property
    def polygon_sizes(self) -> NDArray[np.int64]:
        """int64 [p], the number of corners of each polygon."""
        return np.diff(self.offsets)

    @property
    def normals(self) -> Floats:
        """float64 [p, 3], the unit vector along each gradient; zero where the gradient is zero."""
        return unit_vectors(self.gradients)

    @cached_property
    def unmatched(self) -> NDArray[np.int64]:
        """The corners whose edge lies inside the box but has no neighbour; empty for a surface that closes."""
        return np.flatnonzero((self.twins < 0) & (self.box_faces < 0))

    @property
    def boundary(self) -> NDArray[np.int64]:
        """The corners whose edge has no neighbour because it lies on the box."""
        return np.flatnonzero((self.twins < 0) & (self.box_faces >= 0))

    @cached_property
    def measures(self) -> PolygonMeasures:
        return measure_polygons(self.vertices, self.offsets, self.corners, resolve_threads(None))

    @cached_property
    def umbrellas(self) -> Umbrellas:
        return find_umbrellas(self.offsets, self.corners, self.twins, self.n_vertices, resolve_threads(None))

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """The connected parts with volume, area and genus of each, in the order of their first polygons."""
        return find_components(self.offsets, self.corners, self.twins, self.umbrellas.manifold, self.measures)

    @property
    def area(self) -> float:
        return float(self.measures.areas.sum())

    @property
    def volume(self) -> float | None:
        """The volume in which ``f`` is negative; None for a surface that is not closed."""
        return None if (self.twins < 0).any() else float(self.measures.volumes.sum())

    def centres(self, polygons: NDArray[np.int64]) -> Floats:
        """The mean of the corners of each of ``polygons`` (int64 [n]), float64 [n, 3]."""
        sizes = self.polygon_sizes[polygons]
        firsts = np.cumsum(sizes) - sizes
        corners = np.arange(sizes.sum()) + np.repeat(self.offsets[polygons] - firsts, sizes)
        totals = np.add.reduceat(self.vertices[self.corners[corners]], firsts, axis=0)
        return np.asarray(totals / sizes[:, None])

    def triangles(self) -> Indices:
        """The polygons as fans of triangles: vertex indices [c - 2 p, 3], polygon by polygon."""
        return fan_triangles(self.vertices, self.offsets, self.corners, resolve_threads(None))

    def triangle_polygons(self) -> Indices:
        """The polygon of each triangle of `triangles`, [c - 2 p]."""
        dtype = index_dtype(self.n_polygons)
        return np.repeat(np.arange(self.n_polygons, dtype=dtype), self.polygon_sizes - 2)

    def to_trimesh(self) -> trimesh.Trimesh:
        """A `trimesh.Trimesh` of the triangles, with the same vertices and the exact normals."""
        import trimesh

        return trimesh.Trimesh(
            vertices=self.vertices,
            faces=self.triangles(),
            face_normals=self.normals[self.triangle_polygons()],
            process=False,
            validate=False,
        )

    def with_report(self, **entries: Any) -> Surface:
        """The same surface with ``entries`` added to its report."""
        return replace(self, report={**self.report, **entries})


def unit_vectors(vectors: Floats) -> Floats:
    """Vectors [n, 3] of length 1 in the directions of ``vectors`` [n, 3]; zero where these are."""
    sizes = lengths(vectors)
    return np.asarray(vectors / np.where(sizes > 0, sizes, 1.0)[:, None])
