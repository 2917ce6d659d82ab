"""Clean-up of degenerate meshes: edges without length and the polygons that they leave without area.

An arrangement of planes in general position needs none of this. Where planes meet by design (integer weights,
symmetric shapes), one point comes out as several vertices, equal or as far apart as a perturbation has put them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype, resolve_threads
from mn_onnx.extract.components import connected_roots
from mn_onnx.extract.edges import half_edge_heads, pair_half_edges
from mn_onnx.extract.half_edges import collapse_pass, link_half_edges
from mn_onnx.extract.surface import Surface


@dataclass(frozen=True)
class CleanUp:
    """What a clean-up did.

    ``collapsed_edges``, and ``refused_edges``: short ones that had to stay because the topology would change;
    ``removed_polygons`` that vanished; ``largest_displacement`` of a vertex.
    """

    collapsed_edges: int
    refused_edges: int
    removed_polygons: int
    largest_displacement: float


def collapse_short_edges(surface: Surface, length: float = 0.0) -> tuple[Surface, CleanUp]:
    """Collapse every edge of at most ``length`` whose collapse keeps the topology.

    The surface stays closed, oriented and a manifold wherever it was; vertices on the box stay on their box faces. A
    merged vertex stands where one of its vertices stood. Polygons of fewer than three corners vanish and their
    neighbours are joined. The order of what is left does not change, vertices are numbered by their first corner.

    Raises ValueError if ``length`` is negative or not a number.
    """
    if not length >= 0:
        raise ValueError(f"length is {length}, but a length of at least 0 is needed")
    mesh = link_half_edges(surface.offsets, surface.corners, surface.twins, surface.box_faces, surface.n_vertices)
    merged_into = np.arange(surface.n_vertices, dtype=surface.corners.dtype)
    n_collapsed, n_passes = 0, 0
    while True:
        n_now, n_refused = collapse_pass(mesh, surface.vertices, length, merged_into, 1 + n_passes * surface.n_corners)
        n_collapsed += n_now
        n_passes += 1
        if not n_now:
            break
    if not n_collapsed:
        return surface, CleanUp(0, n_refused, 0, 0.0)
    while not np.array_equal(merged_into, merged_into[merged_into]):
        merged_into = merged_into[merged_into]

    alive = mesh.following >= 0
    new_corner = np.cumsum(alive, dtype=surface.twins.dtype) - 1
    twins = mesh.twins[alive]
    cleaned = _compacted(surface, mesh.tails[alive], mesh.sizes, mesh.box_faces[alive])
    cleaned = replace(cleaned, twins=np.where(twins >= 0, new_corner[twins], -1).astype(twins.dtype))
    return _reported(surface, cleaned, merged_into, n_collapsed, n_refused)


def merge_zero_length_edges(surface: Surface, *, threads: int | None = None) -> tuple[Surface, CleanUp]:
    """Make the ends of every edge of length zero one vertex and pair all edges anew.

    Unlike `collapse_short_edges` this also joins polygons across unmatched edges, whose keys rounding has torn apart;
    the topology is what the merged vertices say, so check the invariants of the result.
    """
    heads = half_edge_heads(surface.offsets, surface.corners)
    short = (surface.vertices[surface.corners] == surface.vertices[heads]).all(axis=1)
    merged_into = connected_roots(surface.corners[short], heads[short], surface.n_vertices)
    tails, heads = merged_into[surface.corners], merged_into[heads]
    kept = tails != heads
    counted = np.concatenate([np.zeros(1, np.int64), np.cumsum(kept)])
    sizes = np.diff(counted[surface.offsets])
    sizes[sizes < 3] = 0
    kept &= np.repeat(sizes > 0, surface.polygon_sizes)
    cleaned = _compacted(surface, tails[kept], sizes, surface.box_faces[kept])
    twins = pair_half_edges(cleaned.offsets, cleaned.corners, cleaned.n_vertices, resolve_threads(threads))
    n_merged = int(np.count_nonzero(merged_into != np.arange(surface.n_vertices)))
    return _reported(surface, replace(cleaned, twins=twins), merged_into, n_merged, 0)


def _compacted(surface: Surface, corners: Indices, sizes: NDArray[np.int64], box_faces: NDArray[np.int8]) -> Surface:
    """Polygons with ``sizes`` > 0 and their ``corners``, vertices numbered by first corner; twins are left to set."""
    kept = sizes > 0
    used, first_corners, numbers = np.unique(corners, return_index=True, return_inverse=True)
    by_first_corner = np.argsort(first_corners)
    renumbered = np.empty(used.size, index_dtype(used.size))
    renumbered[by_first_corner] = np.arange(used.size)
    return Surface(
        vertices=surface.vertices[used[by_first_corner]],
        offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes[kept])]),
        corners=renumbered[numbers.reshape(-1)],
        twins=np.empty(0, surface.twins.dtype),
        box_faces=box_faces,
        gradients=surface.gradients[kept],
        errors=surface.errors[kept],
        attributes={name: values[kept] for name, values in surface.attributes.items()},
        report=surface.report,
    )


def _reported(
    before: Surface, after: Surface, merged_into: Indices, n_collapsed: int, n_refused: int
) -> tuple[Surface, CleanUp]:
    moved = before.vertices - before.vertices[merged_into]
    clean_up = CleanUp(
        collapsed_edges=n_collapsed,
        refused_edges=n_refused,
        removed_polygons=before.n_polygons - after.n_polygons,
        largest_displacement=float(np.sqrt((moved**2).sum(axis=1)).max(initial=0.0)),
    )
    entries: Mapping[str, Any] = {"clean_up": asdict(clean_up)}
    return after.with_report(**entries), clean_up
