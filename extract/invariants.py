"""Named invariants of a mesh: what a right extraction guarantees, measured rather than assumed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mn_onnx.extract.components import Component, unpaired_edges
from mn_onnx.extract.surface import Surface

POSITION_ROUNDING = 1e-12
"""Error allowed in a coordinate, relative to the largest one, before the orientation of a polygon is called wrong."""

BOX_ROUNDING = 1e-9
"""Distance from a box face, relative to the box, within which an edge is on it; above the rounding of a cut."""


@dataclass(frozen=True)
class Invariants:
    """Counts and measures of a `Surface`.

    ``edges`` are undirected. ``boundary_edges`` have one polygon and lie on the box; ``unmatched_edges`` are half-edges
    inside the box without a partner, among them the half-edges of ``misoriented_edges`` (two polygons that run along
    the edge in the same direction) and ``nonmanifold_edges`` (three or more polygons). ``off_box_edges`` are boundary
    edges that do not lie where they claim; 0 where the box was not given. ``euler`` is vertices in use - edges +
    polygons. ``valences``: how many vertices inside the box have how many edges. ``degenerate_polygons`` have no area,
    ``polygons_with_zero_edges`` an edge without length; ``flipped_polygons`` face against their gradient by more than
    rounding. ``volume`` is None where the surface is not closed.
    """

    polygons: int
    vertices: int
    edges: int
    euler: int
    components: tuple[Component, ...]
    boundary_edges: int
    off_box_edges: int
    unmatched_edges: int
    misoriented_edges: int
    nonmanifold_edges: int
    nonmanifold_vertices: int
    degenerate_polygons: int
    polygons_with_zero_edges: int
    flipped_polygons: int
    position_disagreements: int
    shortest_edge: float | None
    valences: dict[int, int]
    area: float
    volume: float | None

    @property
    def closed(self) -> bool:
        """Every edge inside the box joins two polygons."""
        return self.unmatched_edges == 0

    @property
    def watertight(self) -> bool:
        """Closed, and without boundary on the box."""
        return self.closed and self.boundary_edges == 0

    @property
    def oriented(self) -> bool:
        """Neighbours run along their common edge in opposite directions, and no polygon faces against its gradient."""
        return self.misoriented_edges == 0 and self.flipped_polygons == 0

    @property
    def manifold(self) -> bool:
        """At most two polygons at each edge, and one ring or fan of polygons at each vertex."""
        return self.nonmanifold_edges == 0 and self.nonmanifold_vertices == 0

    def problems(self) -> list[str]:
        """What a correct extraction never shows, a sentence each; empty if all is well."""
        return [
            text
            for count, text in (
                (self.unmatched_edges, f"{self.unmatched_edges} edges inside the box have no neighbour"),
                (self.misoriented_edges, f"{self.misoriented_edges} edges join polygons of opposite orientation"),
                (self.nonmanifold_edges, f"{self.nonmanifold_edges} edges have more than two polygons"),
                (
                    self.nonmanifold_vertices,
                    f"{self.nonmanifold_vertices} vertices have no single ring of polygons",
                ),
                (self.off_box_edges, f"{self.off_box_edges} boundary edges do not lie on the box"),
                (self.flipped_polygons, f"{self.flipped_polygons} polygons face against their gradient"),
                (self.position_disagreements, f"{self.position_disagreements} vertices have corners that lie apart"),
            )
            if count
        ]

    def notes(self) -> list[str]:
        """What is legal but worth knowing, a sentence each."""
        return [
            text
            for count, text in (
                (self.degenerate_polygons, f"{self.degenerate_polygons} polygons have no area"),
                (
                    self.polygons_with_zero_edges,
                    f"{self.polygons_with_zero_edges} polygons have an edge of length zero",
                ),
                (self.boundary_edges, f"the surface leaves the box along {self.boundary_edges} edges"),
            )
            if count
        ]

    def as_dict(self) -> dict[str, Any]:
        """All values, ready for JSON; ``components`` is their number and ``component_list`` has the values of each."""
        values = asdict(self)
        values["components"] = len(self.components)
        values["component_list"] = [{**asdict(component), "euler": component.euler} for component in self.components]
        values["valences"] = {str(valence): count for valence, count in self.valences.items()}
        for name in ("closed", "watertight", "oriented", "manifold"):
            values[name] = getattr(self, name)
        return values


def _check_bounds(bounds: ArrayLike) -> NDArray[np.float64]:
    box = np.asarray(bounds, np.float64)
    if box.shape != (3, 2) or not (box[:, 0] < box[:, 1]).all():
        raise ValueError(f"bounds {box.tolist()} are not three pairs of lower < upper")
    return box


def mark_box_edges(surface: Surface, bounds: ArrayLike, *, tolerance: float = 1e-6) -> Surface:
    """The surface with every unpaired edge that lies on a face of the box marked as such in ``box_faces``.

    For meshes from files, which do not tell. ``bounds``: [3, 2], lower and upper per axis; ``tolerance``: relative to
    the largest side of the box, by default that of float32 coordinates. Raises ValueError for malformed bounds.
    """
    box = _check_bounds(bounds)
    unpaired, tails, heads = unpaired_edges(surface.offsets, surface.corners, surface.twins)
    ends = surface.vertices[np.stack([tails, heads], axis=1)]
    distances = np.abs(ends[:, :, :, None] - box).max(axis=1).reshape(-1, 6)
    faces = np.where(distances.min(axis=1) <= tolerance * (box[:, 1] - box[:, 0]).max(), distances.argmin(axis=1), -1)
    box_faces = np.full(surface.n_corners, -1, np.int8)
    box_faces[unpaired] = faces
    return replace(surface, box_faces=box_faces)


def _count_off_box(surface: Surface, bounds: ArrayLike) -> int:
    box = _check_bounds(bounds)
    unpaired, tails, heads = unpaired_edges(surface.offsets, surface.corners, surface.twins)
    faces = surface.box_faces[unpaired]
    on_box = faces >= 0
    axes, sides = faces[on_box] // 2, faces[on_box] % 2
    ends = surface.vertices[np.stack([tails, heads], axis=1)[on_box]]
    along_axis = np.take_along_axis(ends, axes[:, None, None].astype(np.int64), axis=2)[:, :, 0]
    apart = np.abs(along_axis - box[axes, sides][:, None]).max(axis=1, initial=0.0)
    return int((apart > BOX_ROUNDING * (box[:, 1] - box[:, 0]).max()).sum())


def check_invariants(surface: Surface, *, bounds: ArrayLike | None = None) -> Invariants:
    """Measure all invariants of ``surface``.

    ``bounds``: [3, 2], lower and upper per axis of the box; given, the boundary edges are checked to lie on it.
    """
    unpaired, tails, heads = unpaired_edges(surface.offsets, surface.corners, surface.twins)
    ends = np.stack([np.minimum(tails, heads), np.maximum(tails, heads)], axis=1)
    open_edges, edge_of, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    ascending = np.bincount(edge_of.reshape(-1), weights=tails < heads, minlength=len(open_edges))
    n_unmatched = int((surface.box_faces[unpaired] < 0).sum())
    n_edges = (surface.n_corners - unpaired.size) // 2 + len(open_edges)

    umbrellas = surface.umbrellas
    inside = (umbrellas.gaps == 0) & (umbrellas.polygons > 0)
    valences = np.bincount(umbrellas.valences[inside])

    measures = surface.measures
    areas = measures.areas
    facing = np.einsum("ij,ij->i", measures.area_vectors, surface.normals)
    rounding = POSITION_ROUNDING * np.abs(surface.vertices).max(initial=0.0)
    n_used = int((umbrellas.polygons > 0).sum())
    return Invariants(
        polygons=surface.n_polygons,
        vertices=surface.n_vertices,
        edges=n_edges,
        euler=n_used - n_edges + surface.n_polygons,
        components=surface.components,
        boundary_edges=int(unpaired.size) - n_unmatched,
        off_box_edges=0 if bounds is None else _count_off_box(surface, bounds),
        unmatched_edges=n_unmatched,
        misoriented_edges=int(((uses == 2) & ((ascending == 0) | (ascending == 2))).sum()),
        nonmanifold_edges=int((uses > 2).sum()),
        nonmanifold_vertices=int((~umbrellas.manifold).sum()),
        degenerate_polygons=int((areas == 0).sum()),
        polygons_with_zero_edges=int((measures.shortest_edges == 0).sum()),
        flipped_polygons=int((facing < -rounding * measures.perimeters).sum()),
        position_disagreements=int(surface.report.get("position_disagreements", 0)),
        shortest_edge=float(measures.shortest_edges.min()) if surface.n_polygons else None,
        valences={int(valence): int(valences[valence]) for valence in np.flatnonzero(valences)},
        area=surface.area,
        volume=surface.volume,
    )
