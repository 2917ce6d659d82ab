"""The arrays between two surfaces when polygons are removed or their outlines change."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype
from mn_onnx.extract.components import connected_roots
from mn_onnx.extract.edges import preceding_corners
from mn_onnx.extract.surface import Surface


@dataclass(frozen=True, eq=False)
class LinkedMesh:
    """Half-edges in the order of their polygons, [h] each.

    ``tails``: the vertex of the surface that each leaves; ``following``, ``preceding``: its neighbours in its polygon;
    ``twins``: its other direction, -1 for none; ``polygons``: the polygon of the surface it belongs to, ascending;
    ``box_faces`` as in `Surface`.
    """

    tails: Indices
    following: Indices
    preceding: Indices
    twins: Indices
    polygons: Indices
    box_faces: NDArray[np.int8]


def link_in_polygons(polygons: Indices) -> tuple[Indices, Indices]:
    """Next and previous half-edge in the same polygon, for half-edges in order whose ``polygons`` ascend."""
    starts = np.flatnonzero(np.diff(polygons, prepend=-1))
    offsets = np.append(starts, polygons.size)
    preceding = preceding_corners(offsets)
    following = np.empty_like(preceding)
    following[preceding] = np.arange(preceding.size, dtype=preceding.dtype)
    return following, preceding


def as_surface(surface: Surface, mesh: LinkedMesh) -> Surface:
    """``surface`` with the polygons of ``mesh``, and one vertex for each ring or fan of polygons."""
    turned = mesh.twins[mesh.preceding]
    paired = np.flatnonzero(turned >= 0)
    fans = connected_roots(paired.astype(turned.dtype), turned[paired], mesh.tails.size)
    firsts, corners = np.unique(fans, return_inverse=True)
    kept, sizes = np.unique(mesh.polygons, return_counts=True)
    return replace(
        surface,
        vertices=surface.vertices[mesh.tails[firsts]],
        offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)]),
        corners=corners.reshape(-1).astype(index_dtype(firsts.size)),
        twins=mesh.twins.astype(index_dtype(mesh.twins.size)),
        box_faces=mesh.box_faces,
        gradients=surface.gradients[kept],
        errors=surface.errors[kept],
        attributes={name: values[kept] for name, values in surface.attributes.items()},
    )
