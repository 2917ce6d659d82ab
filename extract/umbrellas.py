"""The ring of polygons around each vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import BLOCK_SIZE, Indices, block_count, run_blocks
from mn_onnx.extract.edges import preceding_corners
from mn_onnx.ir.kernel import threaded_kernel


@dataclass(frozen=True, eq=False)
class Umbrellas:
    """What surrounds each of ``v`` vertices.

    ``polygons``: int32 [v], the polygons at the vertex; ``gaps``: int32 [v], the half-edges without a twin that leave
    it.
    ``manifold``: bool [v], whether the polygons form one ring, or one fan if the vertex is on the boundary; a vertex
    without polygons counts as manifold.
    """

    polygons: NDArray[np.int32]
    gaps: NDArray[np.int32]
    manifold: NDArray[np.bool_]

    @property
    def valences(self) -> NDArray[np.int32]:
        """The number of edges at each vertex, int32 [v]."""
        return self.polygons + self.gaps


@threaded_kernel
def _visit_corners(
    corners: Indices, twins: Indices, starts: Indices, polygons: NDArray[np.int32], gaps: NDArray[np.int32]
) -> None:
    """Count polygons and gaps, and choose for each vertex a corner to start from: one before a gap if there is any."""
    for corner in range(corners.size):
        vertex = corners[corner]
        polygons[vertex] += 1
        if twins[corner] < 0:
            gaps[vertex] += 1
            starts[vertex] = corner
        elif gaps[vertex] == 0:
            starts[vertex] = corner


@threaded_kernel
def _walk_umbrellas(
    preceding: Indices,
    twins: Indices,
    starts: Indices,
    polygons: NDArray[np.int32],
    block_size: int,
    first: int,
    last: int,
    manifold: NDArray[np.bool_],
) -> None:
    """Turn around each vertex of blocks ``first .. last``: its umbrella is whole if the turn meets all its polygons."""
    for vertex in range(first * block_size, min(last * block_size, polygons.size)):
        if polygons[vertex] == 0:
            manifold[vertex] = True
            continue
        start = starts[vertex]
        met = 1
        corner = twins[preceding[start]]
        while corner >= 0 and corner != start:
            met += 1
            corner = twins[preceding[corner]]
        manifold[vertex] = met == polygons[vertex]


def find_umbrellas(
    offsets: NDArray[np.int64], corners: Indices, twins: Indices, n_vertices: int, threads: int
) -> Umbrellas:
    """Examine the surroundings of every vertex; ``twins`` as `pair_half_edges` gives them."""
    polygons = np.zeros(n_vertices, np.int32)
    gaps = np.zeros(n_vertices, np.int32)
    starts = np.empty(n_vertices, twins.dtype)
    _visit_corners(corners, twins, starts, polygons, gaps)
    manifold = np.empty(n_vertices, np.bool_)
    preceding = preceding_corners(offsets)
    run_blocks(
        lambda first, last: _walk_umbrellas(preceding, twins, starts, polygons, BLOCK_SIZE, first, last, manifold),
        block_count(n_vertices),
        threads,
    )
    return Umbrellas(polygons, gaps, manifold)
