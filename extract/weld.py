"""Welding: points with the same combinatorial key become one vertex, opposite half-edges become one edge.

No coordinate decides anything here. Points are partitioned by key with a counting sort, and each partition finds the
first point of every key in its own hash table; vertices are numbered by their first corner in canonical order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import (
    FINE_BLOCK,
    Indices,
    block_count,
    group_items,
    index_dtype,
    resolve_threads,
    run_blocks,
)
from mn_onnx.extract.edges import pair_half_edges
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.kernel import threaded_kernel

POSITION_AGREEMENT = 1e-9
"""Points of one vertex may differ by this much, relative to the largest coordinate, before they are reported."""

Floats = NDArray[np.float64]

_POINTS_PER_PARTITION = 1 << 12  # whose hash table fits in the cache of a core
_MAX_PARTITION_BITS = 16  # partition numbers fit in uint16
# Odd constants whose bits look random: xxHash's second prime, and 2^64 over the golden ratio (Knuth, volume 3, 6.4).
_KEY_MIX = 0xC2B2AE3D27D4EB4F
_GOLDEN = 0x9E3779B97F4A7C15


@threaded_kernel
def _mix(low: np.uint64, high: np.uint64) -> np.uint64:
    """A hash of both halves of a key; its upper bits are the key's partition, lower ones its place in a table."""
    return (low ^ (high * np.uint64(_KEY_MIX))) * np.uint64(_GOLDEN)


@threaded_kernel
def _assign_partitions(
    keys: NDArray[np.uint64], bits: int, block_size: int, first: int, last: int, partitions: NDArray[np.uint16]
) -> None:
    """The partition, one of ``2 ** bits``, of the keys in blocks ``first .. last``."""
    for point in range(first * block_size, min(last * block_size, partitions.size)):
        partitions[point] = _mix(keys[point, 0], keys[point, 1]) >> np.uint64(64 - bits)


@threaded_kernel
def _find_first_points(
    keys: NDArray[np.uint64], order: Indices, starts: NDArray[np.int64], first: int, last: int, first_points: Indices
) -> None:
    """For the points of partitions ``first .. last``, the first point that has the same key."""
    for partition in range(first, last):
        begin, end = starts[partition], starts[partition + 1]
        size = 2
        while size < 2 * (end - begin):
            size *= 2
        table = np.full(size, -1, order.dtype)
        gathered = np.empty((end - begin, 2), np.uint64)
        for item in range(end - begin):
            gathered[item, 0] = keys[order[begin + item], 0]
            gathered[item, 1] = keys[order[begin + item], 1]
        for item in range(end - begin):
            low, high = gathered[item, 0], gathered[item, 1]
            slot = np.int64((_mix(low, high) >> np.uint64(16)) & np.uint64(size - 1))
            held = table[slot]
            while held >= 0 and (gathered[held, 0] != low or gathered[held, 1] != high):
                slot = (slot + 1) & (size - 1)
                held = table[slot]
            if held < 0:
                held = item
                table[slot] = item
            first_points[order[begin + item]] = order[begin + held]


@threaded_kernel
def _count_vertices(first_points: Indices, block_size: int, first: int, last: int, counts: NDArray[np.int64]) -> None:
    """The number of first points in each of the blocks ``first .. last``, one place further on in ``counts``."""
    for block in range(first, last):
        count = 0
        for point in range(block * block_size, min((block + 1) * block_size, first_points.size)):
            count += first_points[point] == point
        counts[block + 1] = count


@threaded_kernel
def _number_vertices(
    first_points: Indices,
    positions: Floats,
    block_size: int,
    first_vertices: NDArray[np.int64],
    first: int,
    last: int,
    numbers: Indices,
    vertices: Floats,
) -> None:
    """Give the first points of blocks ``first .. last`` their vertex numbers, and the vertices their positions."""
    for block in range(first, last):
        vertex = first_vertices[block]
        for point in range(block * block_size, min((block + 1) * block_size, first_points.size)):
            if first_points[point] == point:
                numbers[point] = vertex
                for axis in range(3):
                    vertices[vertex, axis] = positions[point, axis]
                vertex += 1


@threaded_kernel
def _number_other_points(
    first_points: Indices,
    positions: Floats,
    block_size: int,
    tolerance: float,
    first: int,
    last: int,
    numbers: Indices,
    apart: NDArray[np.bool_],
    gaps: Floats,
) -> None:
    """Number the points that are not first; mark vertices with a point further than ``tolerance`` from the first one.

    ``gaps``: how far such points are, the farthest one of each block.
    """
    for block in range(first, last):
        for point in range(block * block_size, min((block + 1) * block_size, first_points.size)):
            leader = first_points[point]
            if leader == point:
                continue
            numbers[point] = numbers[leader]
            gap = 0.0
            for axis in range(3):
                gap = max(gap, abs(positions[point, axis] - positions[leader, axis]))
            if not gap <= tolerance:
                gaps[block] = max(gaps[block], gap)
                apart[numbers[point]] = True


@threaded_kernel
def _number_corners(
    points: Indices, numbers: Indices, block_size: int, first: int, last: int, corners: Indices
) -> None:
    """The vertex of each corner in blocks ``first .. last``: that of its point."""
    for corner in range(first * block_size, min(last * block_size, corners.size)):
        corners[corner] = numbers[points[corner]]


def _check_soup(soup: PolygonSoup) -> None:
    n_polygons, n_corners, n_points = soup.offsets.size - 1, soup.corners.size, soup.positions.shape[0]
    expected: dict[str, tuple[tuple[int, ...], type[Any]]] = {
        "offsets": ((n_polygons + 1,), np.int64),
        "corners": ((n_corners,), np.int32 if soup.corners.dtype == np.int32 else np.int64),
        "positions": ((n_points, 3), np.float64),
        "keys": ((n_points, 2), np.uint64),
        "box_faces": ((n_corners,), np.int8),
        "gradients": ((n_polygons, 3), np.float64),
        "errors": ((n_polygons,), np.float64),
    }
    problems = []
    for name, (shape, dtype) in expected.items():
        array = getattr(soup, name)
        if array.shape != shape or array.dtype != dtype:
            problems.append(f"{name} is {array.dtype}{list(array.shape)}, expected {np.dtype(dtype)}{list(shape)}")
    sizes = np.diff(soup.offsets)
    if n_polygons < 0 or soup.offsets[0] != 0 or soup.offsets[-1] != n_corners or (sizes < 3).any():
        problems.append(f"offsets must rise from 0 to the number of corners, {n_corners}, by at least 3 each")
    if n_corners and not 0 <= soup.corners.min() <= soup.corners.max() < n_points:
        problems.append(f"corners must be numbers of points, below {n_points}")
    if problems:
        raise ValueError("not a polygon soup: " + "; ".join(problems))


def _group_by_key(keys: NDArray[np.uint64], threads: int) -> tuple[Indices, NDArray[np.int64]]:
    """Points in partitions such that equal keys share one; as `group_items` returns them."""
    n_points = keys.shape[0]
    bits = min(_MAX_PARTITION_BITS, max(1, (n_points // _POINTS_PER_PARTITION).bit_length()))
    partitions = np.empty(n_points, np.uint16)
    run_blocks(
        lambda first, last: _assign_partitions(keys, bits, FINE_BLOCK, first, last, partitions),
        block_count(n_points, FINE_BLOCK),
        threads,
    )
    return group_items(partitions, 1 << bits, threads)


def first_of_equal_keys(keys: NDArray[np.uint64], threads: int) -> Indices:
    """For each row of ``keys``, uint64 [n, 2], the first row equal to it: [n]."""
    order, starts = _group_by_key(keys, threads)
    first_points = np.empty_like(order)
    run_blocks(
        lambda first, last: _find_first_points(keys, order, starts, first, last, first_points),
        starts.size - 1,
        threads,
    )
    return first_points


def _weld_points(soup: PolygonSoup, threads: int) -> tuple[Floats, Indices, int, float]:
    """Vertices, the vertex of each point, how many vertices have points apart, and by how much at most."""
    first_points = first_of_equal_keys(soup.keys, threads)
    n_blocks = block_count(first_points.size, FINE_BLOCK)
    counts = np.zeros(n_blocks + 1, np.int64)
    run_blocks(lambda first, last: _count_vertices(first_points, FINE_BLOCK, first, last, counts), n_blocks, threads)
    first_vertices = np.cumsum(counts)
    n_vertices = int(first_vertices[-1])
    vertices = np.empty((n_vertices, 3))
    numbers = np.empty(first_points.size, index_dtype(n_vertices))
    run_blocks(
        lambda first, last: _number_vertices(
            first_points, soup.positions, FINE_BLOCK, first_vertices, first, last, numbers, vertices
        ),
        n_blocks,
        threads,
    )
    tolerance = POSITION_AGREEMENT * max(float(vertices.max(initial=0.0)), -float(vertices.min(initial=0.0)))
    apart = np.zeros(n_vertices, np.bool_)
    gaps = np.zeros(n_blocks)
    run_blocks(
        lambda first, last: _number_other_points(
            first_points, soup.positions, FINE_BLOCK, tolerance, first, last, numbers, apart, gaps
        ),
        n_blocks,
        threads,
    )
    return vertices, numbers, int(np.count_nonzero(apart)), float(gaps.max(initial=0.0))


def weld(soup: PolygonSoup, *, threads: int | None = None) -> Surface:
    """Join the polygons of ``soup`` into a `Surface`.

    A vertex stands where its first corner in canonical order stands. The surface's ``report`` tells

    - ``position_disagreements``: vertices with a corner further than `POSITION_AGREEMENT` (relative) from the first
      one: a collision of keys or a degenerate arrangement;
    - ``max_position_disagreement``: the largest such distance (maximum norm), 0 if there is none.

    ``threads``: None takes all cores; the result is the same for any number. Raises ValueError for a malformed soup.
    """
    _check_soup(soup)
    threads = resolve_threads(threads)
    vertices, numbers, disagreements, gap = _weld_points(soup, threads)
    corners = np.empty(soup.corners.size, numbers.dtype)
    run_blocks(
        lambda first, last: _number_corners(soup.corners, numbers, FINE_BLOCK, first, last, corners),
        block_count(corners.size, FINE_BLOCK),
        threads,
    )
    twins = pair_half_edges(soup.offsets, corners, vertices.shape[0], threads)
    return Surface(
        vertices=vertices,
        offsets=soup.offsets,
        corners=corners,
        twins=twins,
        box_faces=soup.box_faces,
        gradients=soup.gradients,
        errors=soup.errors,
        report={"position_disagreements": disagreements, "max_position_disagreement": gap},
    )
