"""The mesh of a degenerate network as the limit of meshes of perturbed ones.

While a perturbation is small enough not to change which planes meet, every vertex is the intersection of the same
planes of the same linear pieces, all shifted in proportion to its scale. So vertices move linearly in the scale, and
two scales give them at scale zero exactly, up to rounding: x(0) = x(1/2) + (x(1/2) - x(1)). That nothing changed is
seen from the combinatorial keys, which must be the same at both scales.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.surface import Surface

SCALES = (1.0, 0.5)
"""The two scales whose meshes `limit_surface` takes, in this order; both are exact in binary."""


def limit_surface(
    soups: tuple[PolygonSoup, PolygonSoup], surfaces: tuple[Surface, Surface]
) -> tuple[Surface, float] | None:
    """The mesh at scale zero from those at `SCALES`, and how far the nearer one's vertices were from it at most.

    ``surfaces`` are the welded ``soups``. The topology is that of the second. None if the two differ in more than the
    positions of vertices.
    """
    far_keys, near_keys = (_vertex_keys(soup, surface) for soup, surface in zip(soups, surfaces, strict=True))
    far_order, near_order = _by_key(far_keys), _by_key(near_keys)
    if not np.array_equal(far_keys[far_order], near_keys[near_order]):
        return None
    far_polygons, near_polygons = (_polygon_words(soup) for soup in soups)
    if not np.array_equal(far_polygons[_by_key(far_polygons)], near_polygons[_by_key(near_polygons)]):
        return None
    far, near = surfaces
    moved = np.empty_like(near.vertices)
    moved[near_order] = near.vertices[near_order] - far.vertices[far_order]
    displacement = float(np.sqrt((moved**2).sum(axis=1)).max(initial=0.0))
    return replace(near, vertices=near.vertices + moved), displacement


def _vertex_keys(soup: PolygonSoup, surface: Surface) -> NDArray[np.uint64]:
    """The key of every vertex, uint64 [v, 2]."""
    _, first_corners = np.unique(surface.corners, return_index=True)
    return np.asarray(soup.keys[soup.corners[first_corners]])


def _by_key(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    return np.lexsort((keys[:, 1], keys[:, 0]))


def _polygon_words(soup: PolygonSoup) -> NDArray[np.uint64]:
    """Words that tell which vertices a polygon has, uint64 [p, 2]: the sum of its corners' keys, modulo 2^64."""
    if soup.offsets.size == 1:
        return np.zeros((0, 2), np.uint64)
    return np.asarray(np.add.reduceat(soup.corner_keys, soup.offsets[:-1], axis=0))
