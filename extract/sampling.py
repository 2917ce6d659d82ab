"""Random points on a surface, uniform by area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]


@threaded_kernel
def _place(
    vertices: Floats,
    offsets: NDArray[np.int64],
    corners: Indices,
    polygons: NDArray[np.int64],
    shares: Floats,
    along: Floats,
    across: Floats,
    points: Floats,
) -> None:
    """In each polygon, the triangle of its first corner's fan at which ``shares`` of the area are reached, and a point.

    A triangle's point is (1 - sqrt(a)) A + sqrt(a) (1 - b) B + sqrt(a) b C (Osada et al., "Shape distributions", 2002).
    """
    edge, diagonal, cross = np.empty(3), np.empty(3), np.empty(3)
    for sample in range(polygons.size):
        begin, end = offsets[polygons[sample]], offsets[polygons[sample] + 1]
        apex = corners[begin]
        left = shares[sample]
        chosen = begin + 1
        for corner in range(begin + 1, end - 1):
            for axis in range(3):
                edge[axis] = vertices[corners[corner], axis] - vertices[apex, axis]
                diagonal[axis] = vertices[corners[corner + 1], axis] - vertices[apex, axis]
            for axis in range(3):
                b, c = (axis + 1) % 3, (axis + 2) % 3
                cross[axis] = edge[b] * diagonal[c] - edge[c] * diagonal[b]
            area = 0.5 * np.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
            if area > 0:
                chosen = corner
            if left < area:
                break
            left -= area
        outward = np.sqrt(along[sample])
        weight_b, weight_c = outward * (1 - across[sample]), outward * across[sample]
        for axis in range(3):
            points[sample, axis] = (
                (1 - outward) * vertices[apex, axis]
                + weight_b * vertices[corners[chosen], axis]
                + weight_c * vertices[corners[chosen + 1], axis]
            )


def sample_surface(surface: Surface, n_samples: int, *, seed: int = 0) -> tuple[Floats, NDArray[np.int64]]:
    """Random points, uniform by area: ``points``, float64 [n_samples, 3], and ``polygons``, int64 [n_samples].

    The same ``seed`` gives the same points. Raises ValueError if the surface has no area.
    """
    cumulated = np.cumsum(surface.measures.areas)
    if not cumulated.size or not cumulated[-1] > 0:
        raise ValueError("a surface without area has no points to sample")
    generator = np.random.default_rng(seed)
    position = generator.random(n_samples) * cumulated[-1]
    polygons = np.minimum(np.searchsorted(cumulated, position, side="right"), cumulated.size - 1)
    shares = position - np.where(polygons > 0, cumulated[polygons - 1], 0.0)
    along, across = generator.random(n_samples), generator.random(n_samples)
    points = np.empty((n_samples, 3))
    _place(surface.vertices, surface.offsets, surface.corners, polygons, shares, along, across, points)
    return points, polygons
