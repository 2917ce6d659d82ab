"""Convex polygons into triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import FINE_BLOCK, Indices, block_count, run_blocks
from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]


@threaded_kernel
def _fan(
    vertices: Floats,
    offsets: NDArray[np.int64],
    corners: Indices,
    widest: int,
    block_size: int,
    first: int,
    last: int,
    triangles: Indices,
) -> None:
    """Fans of the polygons in blocks ``first .. last``, each from the apex whose smallest triangle is largest.

    ``widest``: the most corners that a polygon has.
    """
    ring = np.empty((2 * widest, 3))  # the corners twice, so that every fan is a stretch of them
    members = np.empty(2 * widest, corners.dtype)
    for polygon in range(first * block_size, min(last * block_size, offsets.size - 1)):
        begin = offsets[polygon]
        n = offsets[polygon + 1] - begin
        for k in range(n):
            vertex = corners[begin + k]
            members[k] = members[n + k] = vertex
            for axis in range(3):
                ring[k, axis] = ring[n + k, axis] = vertices[vertex, axis]
        best_apex, best_area = 0, -1.0
        for apex in range(n if n > 3 else 0):
            smallest = np.inf
            ux, uy, uz = (
                ring[apex + 1, 0] - ring[apex, 0],
                ring[apex + 1, 1] - ring[apex, 1],
                ring[apex + 1, 2] - ring[apex, 2],
            )
            for corner in range(apex + 2, apex + n):
                wx, wy, wz = (
                    ring[corner, 0] - ring[apex, 0],
                    ring[corner, 1] - ring[apex, 1],
                    ring[corner, 2] - ring[apex, 2],
                )
                area = (uy * wz - uz * wy) ** 2 + (uz * wx - ux * wz) ** 2 + (ux * wy - uy * wx) ** 2
                smallest = min(smallest, area)
                if smallest <= best_area:
                    break
                ux, uy, uz = wx, wy, wz
            if smallest > best_area:
                best_apex, best_area = apex, smallest
        triangle = begin - 2 * polygon
        for corner in range(best_apex + 1, best_apex + n - 1):
            triangles[triangle, 0] = members[best_apex]
            triangles[triangle, 1] = members[corner]
            triangles[triangle, 2] = members[corner + 1]
            triangle += 1


def fan_triangles(vertices: Floats, offsets: NDArray[np.int64], corners: Indices, threads: int) -> Indices:
    """Triangles [c - 2 p, 3] of convex polygons, each polygon a fan, in the order and orientation of the polygons.

    The apex of a fan is the corner whose smallest triangle is largest, so that no triangle is degenerate if any fan
    of the polygon avoids it. Polygon ``i`` owns the triangles from ``offsets[i] - 2 i`` on. The dtype is that of
    ``corners``.
    """
    n_polygons = offsets.size - 1
    triangles = np.empty((corners.size - 2 * n_polygons, 3), corners.dtype)
    widest = int(np.diff(offsets).max(initial=0))
    run_blocks(
        lambda first, last: _fan(vertices, offsets, corners, widest, FINE_BLOCK, first, last, triangles),
        block_count(n_polygons, FINE_BLOCK),
        threads,
    )
    return triangles
