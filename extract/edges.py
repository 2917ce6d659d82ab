"""Half-edge pairing: which corner's edge runs along the same edge in the neighbouring polygon.

The half-edge of corner ``c`` runs from the vertex of ``c`` to the vertex of the next corner of its polygon.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import BLOCK_SIZE, FINE_BLOCK, Indices, block_count, group_items, index_dtype, run_blocks

_MAX_PARTITIONS = 1 << 16  # their numbers fit in uint16
_CORNERS_PER_PARTITION = 1 << 13  # whose counters fit in the cache of a core


def half_edge_heads(offsets: NDArray[np.int64], corners: Indices) -> Indices:
    """The vertex at which each half-edge ends: [c], of the dtype of ``corners``."""
    heads = np.empty_like(corners)
    if corners.size:
        heads[:-1] = corners[1:]
        heads[offsets[1:] - 1] = corners[offsets[:-1]]
    return heads


def preceding_corners(offsets: NDArray[np.int64]) -> Indices:
    """The corner before each corner in its polygon, [c]."""
    n_corners = int(offsets[-1])
    preceding = np.arange(-1, n_corners - 1, dtype=index_dtype(n_corners))
    preceding[offsets[:-1]] = offsets[1:] - 1
    return preceding


@numba.njit(cache=True, nogil=True)
def _link_corners(
    offsets: NDArray[np.int64],
    corners: Indices,
    block_size: int,
    first: int,
    last: int,
    heads: Indices,
    preceding: Indices,
    twins: Indices,
) -> None:
    """`half_edge_heads` and `preceding_corners` of the polygons in blocks ``first .. last``; twins are -1 so far."""
    for polygon in range(first * block_size, min(last * block_size, offsets.size - 1)):
        begin, end = offsets[polygon], offsets[polygon + 1]
        previous = end - 1
        for corner in range(begin, end):
            preceding[corner] = previous
            heads[previous] = corners[corner]
            twins[corner] = -1
            previous = corner


@numba.njit(cache=True, nogil=True)
def _sort_partitions(
    corners: Indices,
    order: Indices,
    partition_starts: NDArray[np.int64],
    shift: int,
    first: int,
    last: int,
    vertex_starts: NDArray[np.int64],
) -> None:
    """Sort the corners of partitions ``first .. last`` by vertex, in place and stably."""
    for partition in range(first, last):
        begin, end = partition_starts[partition], partition_starts[partition + 1]
        first_vertex = partition << shift
        last_vertex = min((partition + 1) << shift, vertex_starts.size - 1)
        cursors = np.zeros(last_vertex - first_vertex, np.int64)
        for position in range(begin, end):
            cursors[corners[order[position]] - first_vertex] += 1
        total = begin
        for vertex in range(first_vertex, last_vertex):
            count = cursors[vertex - first_vertex]
            vertex_starts[vertex] = cursors[vertex - first_vertex] = total
            total += count
        unsorted = order[begin:end].copy()
        for corner in unsorted:
            vertex = corners[corner] - first_vertex
            order[cursors[vertex]] = corner
            cursors[vertex] += 1


def corners_by_vertex(corners: Indices, n_vertices: int, threads: int) -> tuple[Indices, NDArray[np.int64]]:
    """Corners sorted by vertex: ``order`` [c] and ``starts``, int64 [v + 1].

    The corners at vertex ``i`` are ``order[starts[i]:starts[i + 1]]``, ascending.
    """
    wanted = max(1, min(_MAX_PARTITIONS, corners.size // _CORNERS_PER_PARTITION))
    shift = (-(-n_vertices // wanted) - 1).bit_length()
    n_partitions = -(-n_vertices >> shift)
    partitions = np.empty(corners.size, np.uint16)

    def assign_partitions(first: int, last: int) -> None:
        for block in range(first, last):
            inside = slice(block * BLOCK_SIZE, (block + 1) * BLOCK_SIZE)
            partitions[inside] = corners[inside] >> shift

    run_blocks(assign_partitions, block_count(corners.size), threads)
    order, partition_starts = group_items(partitions, n_partitions, threads)
    starts = np.empty(n_vertices + 1, np.int64)
    starts[n_vertices] = corners.size
    run_blocks(
        lambda first, last: _sort_partitions(corners, order, partition_starts, shift, first, last, starts),
        n_partitions,
        threads,
    )
    return order, starts


@numba.njit(cache=True, nogil=True)
def _match_at_vertices(
    offsets: NDArray[np.int64],
    corners: Indices,
    heads: Indices,
    preceding: Indices,
    order: Indices,
    starts: NDArray[np.int64],
    widest: int,
    block_size: int,
    first: int,
    last: int,
    twins: Indices,
) -> None:
    """Pair the half-edges at the vertices of blocks ``first .. last``.

    Both half-edges of an edge are seen from either end: the outgoing one of a corner there, the incoming one of the
    corner before. The end with fewer corners looks, so that a vertex of huge valence costs no more than its
    neighbours.
    """
    begin_vertex, end_vertex = first * block_size, min(last * block_size, starts.size - 1)
    largest = 0
    for vertex in range(begin_vertex, end_vertex):
        largest = max(largest, starts[vertex + 1] - starts[vertex])
    # Of every corner at a vertex: where its half-edge ends, and the half-edge that ends in it and where that begins.
    outgoing, incoming = np.empty(largest, corners.dtype), np.empty(largest, corners.dtype)
    before = np.empty(largest, twins.dtype)
    for vertex in range(begin_vertex, end_vertex):
        begin, valence = starts[vertex], starts[vertex + 1] - starts[vertex]
        for k in range(valence):
            corner = order[begin + k]
            before[k] = preceding[corner]
            outgoing[k] = heads[corner]
            incoming[k] = corners[before[k]]
        for k in range(valence):
            head = outgoing[k]
            excess = valence - (starts[head + 1] - starts[head])
            if excess > 0 or (excess == 0 and vertex >= head):
                continue
            corner = partner = order[begin + k]
            n_outgoing = n_incoming = 0
            for other in range(valence):
                n_outgoing += outgoing[other] == head
                fits = incoming[other] == head
                n_incoming += fits
                partner = before[other] if fits else partner
            if n_outgoing != 1 or n_incoming != 1:
                continue
            if abs(partner - corner) < widest:
                polygon = np.searchsorted(offsets, corner, side="right")
                if offsets[polygon - 1] <= partner < offsets[polygon]:
                    continue
            twins[corner] = partner
            twins[partner] = corner


def pair_half_edges(offsets: NDArray[np.int64], corners: Indices, n_vertices: int, threads: int) -> Indices:
    """The twin of every half-edge, -1 where it has none.

    ``offsets``: int64 [p + 1]; ``corners``: int32 or int64 [c], the vertex of each corner, below ``n_vertices``.
    Two half-edges are twins if they join the same two vertices in opposite directions, belong to different polygons
    and no third half-edge joins these vertices. Returns the twins as corner numbers, [c].
    """
    twins: Indices = np.empty(corners.size, index_dtype(corners.size))
    if not corners.size:
        return twins
    order, starts = corners_by_vertex(corners, n_vertices, threads)
    heads, preceding = np.empty_like(corners), np.empty_like(twins)
    run_blocks(
        lambda first, last: _link_corners(offsets, corners, FINE_BLOCK, first, last, heads, preceding, twins),
        block_count(offsets.size - 1, FINE_BLOCK),
        threads,
    )
    widest = int(np.diff(offsets).max())
    run_blocks(
        lambda first, last: _match_at_vertices(
            offsets, corners, heads, preceding, order, starts, widest, FINE_BLOCK, first, last, twins
        ),
        block_count(n_vertices, FINE_BLOCK),
        threads,
    )
    return twins
