"""Half-edge pairing: which corner's edge runs along the same edge in the neighbouring polygon.

The half-edge of corner ``c`` runs from the vertex of ``c`` to the vertex of the next corner of its polygon.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import BLOCK_SIZE, FINE_BLOCK, Indices, block_count, group_items, index_dtype, run_blocks
from mn_onnx.ir.kernel import threaded_kernel

_MAX_PARTITIONS = 1 << 16  # their numbers fit in uint16
_CORNERS_PER_PARTITION = 1 << 13  # whose counters fit in the cache of a core
_FEW = 32  # half-edges, or corners, that are compared with one another
_LATER = -2  # instead of the twin of a half-edge that is to be paired by sorting


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


@threaded_kernel
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


def _partition_shift(n_corners: int, n_vertices: int) -> int:
    """By how many bits a vertex number is shifted to give its partition."""
    wanted = max(1, min(_MAX_PARTITIONS, n_corners // _CORNERS_PER_PARTITION))
    return (-(-n_vertices // wanted) - 1).bit_length()


def corners_by_vertex(corners: Indices, n_vertices: int, threads: int) -> tuple[Indices, NDArray[np.int64]]:
    """Corners sorted by vertex: ``order`` [c] and ``starts``, int64 [v + 1].

    The corners at vertex ``i`` are ``order[starts[i]:starts[i + 1]]``, ascending.
    """
    shift = _partition_shift(corners.size, n_vertices)
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


@threaded_kernel
def _partition_half_edges(
    offsets: NDArray[np.int64],
    corners: Indices,
    shift: int,
    block_size: int,
    first: int,
    last: int,
    heads: Indices,
    partitions: NDArray[np.uint16],
    folded: NDArray[np.bool_],
) -> None:
    """`half_edge_heads` of the polygons in blocks ``first .. last``, and half-edges partitioned by their lower end.

    ``folded``: whether a polygon of the block may run along an edge twice, as only one that meets a vertex twice can.
    """
    for block in range(first, last):
        meets_twice = False
        for polygon in range(block * block_size, min((block + 1) * block_size, offsets.size - 1)):
            begin, end = offsets[polygon], offsets[polygon + 1]
            for corner in range(begin, end):
                head = corners[corner + 1 if corner + 1 < end else begin]
                heads[corner] = head
                partitions[corner] = min(corners[corner], head) >> shift
            if end - begin > _FEW:
                meets_twice = True  # it would take too long to know
                continue
            for corner in range(begin, end):
                for other in range(corner + 1, end):
                    meets_twice |= corners[corner] == corners[other]
        folded[block] = meets_twice


@threaded_kernel
def _in_one_polygon(offsets: NDArray[np.int64], corner: int, other: int) -> bool:
    polygon = np.searchsorted(offsets, corner, side="right")
    return bool(offsets[polygon - 1] <= other < offsets[polygon])


@threaded_kernel
def _pair_partitions(
    offsets: NDArray[np.int64],
    corners: Indices,
    heads: Indices,
    order: Indices,
    starts: NDArray[np.int64],
    shift: int,
    folded: bool,
    first: int,
    last: int,
    twins: Indices,
) -> None:
    """Pair the half-edges of partitions ``first .. last``, sorted by their lower ends.

    ``folded``: whether there may be polygons that run along an edge twice. Half-edges at vertices that are the lower
    end of more than a few get `_LATER`.
    """
    for partition in range(first, last):
        begin, count = starts[partition], starts[partition + 1] - starts[partition]
        first_vertex = partition << shift
        ends = np.zeros((1 << shift) + 1, np.int64)
        lower = np.empty(count, corners.dtype)
        for item in range(count):
            corner = order[begin + item]
            lower[item] = min(corners[corner], heads[corner]) - first_vertex
            ends[lower[item] + 1] += 1
        for vertex in range(1 << shift):
            ends[vertex + 1] += ends[vertex]
        # Of every half-edge its upper end, twice, plus one if it begins there.
        edges, at = np.empty(count, np.int64), np.empty(count, order.dtype)
        for item in range(count):
            corner = order[begin + item]
            tail, head = corners[corner], heads[corner]
            place = ends[lower[item]]
            ends[lower[item]] = place + 1
            edges[place] = 2 * max(tail, head) + (tail > head)
            at[place] = corner
        bucket = 0
        for vertex in range(1 << shift):
            bucket_end = ends[vertex]
            if bucket_end - bucket > _FEW:
                for item in range(bucket, bucket_end):
                    twins[at[item]] = _LATER
                bucket = bucket_end
            for item in range(bucket, bucket_end):
                # Which half-edges meet is as good as random, so nothing branches on it.
                edge = edges[item]
                same, partner = 0, item
                for other in range(bucket, bucket_end):
                    same += edges[other] >> 1 == edge >> 1
                    partner = other if edges[other] == edge ^ 1 else partner
                corner, twin = at[item], at[partner]
                paired = same == 2 and partner != item
                if folded:
                    paired = paired and not _in_one_polygon(offsets, corner, twin)
                twins[corner] = twin if paired else -1
            bucket = bucket_end


def _pair_sorted(left: Indices, offsets: NDArray[np.int64], corners: Indices, heads: Indices, twins: Indices) -> None:
    """Set the twins of the corners ``left`` as `_pair_partitions` does, in the time of sorting."""
    tails, ends = corners[left], heads[left]
    lower, upper, turned = np.minimum(tails, ends), np.maximum(tails, ends), tails > ends
    order = np.lexsort((turned, upper, lower))
    left, lower, upper, turned = left[order], lower[order], upper[order], turned[order]
    twins[left] = -1
    changes = np.flatnonzero((lower[1:] != lower[:-1]) | (upper[1:] != upper[:-1])) + 1
    starts = np.concatenate([[0], changes])
    pairs = starts[np.diff(starts, append=left.size) == 2]
    polygons = np.searchsorted(offsets, left, side="right")
    pairs = pairs[(turned[pairs] != turned[pairs + 1]) & (polygons[pairs] != polygons[pairs + 1])]
    twins[left[pairs]], twins[left[pairs + 1]] = left[pairs + 1], left[pairs]


def pair_half_edges(offsets: NDArray[np.int64], corners: Indices, n_vertices: int, threads: int) -> Indices:
    """The twin of every half-edge, -1 where it has none.

    ``offsets``: int64 [p + 1]; ``corners``: int32 or int64 [c], the vertex of each corner, below ``n_vertices``.
    Two half-edges are twins if they join the same two vertices in opposite directions, belong to different polygons
    and no third half-edge joins these vertices. Returns the twins as corner numbers, [c].
    """
    twins: Indices = np.empty(corners.size, index_dtype(corners.size))
    if not corners.size:
        return twins
    shift = _partition_shift(corners.size, n_vertices)
    heads, partitions = np.empty_like(corners), np.empty(corners.size, np.uint16)
    n_blocks = block_count(offsets.size - 1, FINE_BLOCK)
    folded = np.empty(n_blocks, np.bool_)
    run_blocks(
        lambda first, last: _partition_half_edges(
            offsets, corners, shift, FINE_BLOCK, first, last, heads, partitions, folded
        ),
        n_blocks,
        threads,
    )
    order, starts = group_items(partitions, -(-n_vertices >> shift), threads)
    any_folded = bool(folded.any())
    run_blocks(
        lambda first, last: _pair_partitions(
            offsets, corners, heads, order, starts, shift, any_folded, first, last, twins
        ),
        starts.size - 1,
        threads,
    )
    left = np.flatnonzero(twins == _LATER)
    if left.size:
        _pair_sorted(left, offsets, corners, heads, twins)
    return twins
