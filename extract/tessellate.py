"""Convex polygons into triangles."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import BLOCK_SIZE, Indices, block_count, run_blocks

Floats = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _fan(
    vertices: Floats,
    offsets: NDArray[np.int64],
    corners: Indices,
    block_size: int,
    first: int,
    last: int,
    triangles: Indices,
) -> None:
    """Fans of the polygons in blocks ``first .. last``, each from the apex whose smallest triangle is largest."""
    for polygon in range(first * block_size, min(last * block_size, offsets.size - 1)):
        begin = offsets[polygon]
        n = offsets[polygon + 1] - begin
        best_apex, best_area = 0, -1.0
        for apex in range(n if n > 3 else 0):
            smallest = np.inf
            a = corners[begin + apex]
            for step in range(1, n - 1):
                b = corners[begin + (apex + step) % n]
                c = corners[begin + (apex + step + 1) % n]
                ux, uy, uz = (
                    vertices[b, 0] - vertices[a, 0],
                    vertices[b, 1] - vertices[a, 1],
                    vertices[b, 2] - vertices[a, 2],
                )
                wx, wy, wz = (
                    vertices[c, 0] - vertices[a, 0],
                    vertices[c, 1] - vertices[a, 1],
                    vertices[c, 2] - vertices[a, 2],
                )
                area = (uy * wz - uz * wy) ** 2 + (uz * wx - ux * wz) ** 2 + (ux * wy - uy * wx) ** 2
                smallest = min(smallest, area)
                if smallest <= best_area:
                    break
            if smallest > best_area:
                best_apex, best_area = apex, smallest
        triangle = begin - 2 * polygon
        for step in range(1, n - 1):
            triangles[triangle, 0] = corners[begin + best_apex]
            triangles[triangle, 1] = corners[begin + (best_apex + step) % n]
            triangles[triangle, 2] = corners[begin + (best_apex + step + 1) % n]
            triangle += 1


def fan_triangles(vertices: Floats, offsets: NDArray[np.int64], corners: Indices, threads: int) -> Indices:
    """Triangles [c - 2 p, 3] of convex polygons, each polygon a fan, in the order and orientation of the polygons.

    The apex of a fan is the corner whose smallest triangle is largest, so that no triangle is degenerate if any fan
    of the polygon avoids it. Polygon ``i`` owns the triangles from ``offsets[i] - 2 i`` on. The dtype is that of
    ``corners``.
    """
    n_polygons = offsets.size - 1
    triangles = np.empty((corners.size - 2 * n_polygons, 3), corners.dtype)
    run_blocks(
        lambda first, last: _fan(vertices, offsets, corners, BLOCK_SIZE, first, last, triangles),
        block_count(n_polygons),
        threads,
    )
    return triangles
