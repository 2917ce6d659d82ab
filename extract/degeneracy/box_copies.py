"""Polygons that lie in a face of the box: copies of the face, no part of the level set in the open box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import index_dtype
from mn_onnx.extract.degeneracy.linked_mesh import LinkedMesh, as_surface, link_in_polygons
from mn_onnx.extract.surface import Surface

Floats = NDArray[np.float64]


def drop_box_copies(surface: Surface, lower: Floats, upper: Floats, distance: float) -> tuple[Surface, int]:
    """The surface without the polygons all of whose corners are within ``distance`` of one box face, and their number.

    ``lower``, ``upper``: float64 [3]. The neighbours of these polygons end on that box face then.
    """
    bits = np.zeros(surface.n_vertices, np.uint8)
    for axis, coordinates in enumerate(surface.vertices.T):
        bits |= (coordinates <= lower[axis] + distance).view(np.uint8) << (2 * axis)
        bits |= (coordinates >= upper[axis] - distance).view(np.uint8) << (2 * axis + 1)
    if not bits.any():
        return surface, 0
    common = np.bitwise_and.reduceat(bits[surface.corners], surface.offsets[:-1])
    if not common.any():
        return surface, 0
    faces = np.argmax(common[:, None] & (1 << np.arange(6)), axis=1).astype(np.int8)
    polygons = np.repeat(np.arange(surface.n_polygons, dtype=index_dtype(surface.n_polygons)), surface.polygon_sizes)
    kept = np.flatnonzero(common[polygons] == 0)
    numbers = np.full(surface.n_corners + 1, -1, surface.twins.dtype)  # one more: that of the missing twin, -1
    numbers[kept] = np.arange(kept.size)
    twins = surface.twins[kept]
    across = polygons[twins]
    bordering = (twins >= 0) & (common[across] != 0)
    following, preceding = link_in_polygons(polygons[kept])
    mesh = LinkedMesh(
        surface.corners[kept],
        following,
        preceding,
        numbers[twins],
        polygons[kept],
        np.where(bordering, faces[across], surface.box_faces[kept]),
    )
    return as_surface(surface, mesh), int(np.count_nonzero(common))
