"""Welding: corners with the same combinatorial key become one vertex, opposite half-edges become one edge.

No coordinate decides anything here. Corners are partitioned by key with a counting sort, and each partition finds the
first corner of every key in its own hash table; vertices are numbered by their first corner in canonical order.
"""

from __future__ import annotations

from typing import Any

import numba
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

POSITION_AGREEMENT = 1e-9
"""Corners of one vertex may differ by this much, relative to the largest coordinate, before they are reported."""

Floats = NDArray[np.float64]

_CORNERS_PER_PARTITION = 1 << 12  # whose hash table fits in the cache of a core
_MAX_PARTITION_BITS = 16  # partition numbers fit in uint16
# Odd constants whose bits look random: xxHash's second prime, and 2^64 over the golden ratio (Knuth, volume 3, 6.4).
_KEY_MIX = 0xC2B2AE3D27D4EB4F
_GOLDEN = 0x9E3779B97F4A7C15


@numba.njit(cache=True, nogil=True)
def _mix(low: np.uint64, high: np.uint64) -> np.uint64:
    """A hash of both halves of a key; its upper bits are the key's partition, lower ones its place in a table."""
    return (low ^ (high * np.uint64(_KEY_MIX))) * np.uint64(_GOLDEN)


@numba.njit(cache=True, nogil=True)
def _assign_partitions(
    keys: NDArray[np.uint64], bits: int, block_size: int, first: int, last: int, partitions: NDArray[np.uint16]
) -> None:
    """The partition, one of ``2 ** bits``, of the keys in blocks ``first .. last``."""
    for corner in range(first * block_size, min(last * block_size, partitions.size)):
        partitions[corner] = _mix(keys[corner, 0], keys[corner, 1]) >> np.uint64(64 - bits)


@numba.njit(cache=True, nogil=True)
def _find_first_corners(
    keys: NDArray[np.uint64], order: Indices, starts: NDArray[np.int64], first: int, last: int, first_corners: Indices
) -> None:
    """For the corners of partitions ``first .. last``, the first corner in canonical order that has the same key."""
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
            first_corners[order[begin + item]] = order[begin + held]


@numba.njit(cache=True, nogil=True)
def _count_vertices(first_corners: Indices, block_size: int, first: int, last: int, counts: NDArray[np.int64]) -> None:
    """The number of first corners in each of the blocks ``first .. last``, one place further on in ``counts``."""
    for block in range(first, last):
        count = 0
        for corner in range(block * block_size, min((block + 1) * block_size, first_corners.size)):
            count += first_corners[corner] == corner
        counts[block + 1] = count


@numba.njit(cache=True, nogil=True)
def _number_vertices(
    first_corners: Indices,
    positions: Floats,
    block_size: int,
    first_vertices: NDArray[np.int64],
    first: int,
    last: int,
    corners: Indices,
    vertices: Floats,
) -> None:
    """Give the first corners of blocks ``first .. last`` their vertex numbers, and the vertices their positions."""
    for block in range(first, last):
        vertex = first_vertices[block]
        for corner in range(block * block_size, min((block + 1) * block_size, first_corners.size)):
            if first_corners[corner] == corner:
                corners[corner] = vertex
                for axis in range(3):
                    vertices[vertex, axis] = positions[corner, axis]
                vertex += 1


@numba.njit(cache=True, nogil=True)
def _number_other_corners(
    first_corners: Indices,
    positions: Floats,
    block_size: int,
    tolerance: float,
    first: int,
    last: int,
    corners: Indices,
    disagreements: NDArray[np.int64],
    gaps: Floats,
) -> None:
    """Number the corners that are not first, and measure how far each is from the first corner of its vertex."""
    for block in range(first, last):
        for corner in range(block * block_size, min((block + 1) * block_size, first_corners.size)):
            leader = first_corners[corner]
            if leader == corner:
                continue
            corners[corner] = corners[leader]
            gap = 0.0
            for axis in range(3):
                gap = max(gap, abs(positions[corner, axis] - positions[leader, axis]))
            gaps[block] = max(gaps[block], gap)
            if not gap <= tolerance:
                disagreements[block] += 1


def _check_soup(soup: PolygonSoup) -> None:
    n_polygons, n_corners = soup.offsets.size - 1, soup.positions.shape[0]
    expected: dict[str, tuple[tuple[int, ...], type[Any]]] = {
        "offsets": ((n_polygons + 1,), np.int64),
        "positions": ((n_corners, 3), np.float64),
        "keys": ((n_corners, 2), np.uint64),
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
    if problems:
        raise ValueError("not a polygon soup: " + "; ".join(problems))


def _group_by_key(keys: NDArray[np.uint64], threads: int) -> tuple[Indices, NDArray[np.int64]]:
    """Corners in partitions such that equal keys share one; as `group_items` returns them."""
    n_corners = keys.shape[0]
    bits = min(_MAX_PARTITION_BITS, max(1, (n_corners // _CORNERS_PER_PARTITION).bit_length()))
    partitions = np.empty(n_corners, np.uint16)

    run_blocks(
        lambda first, last: _assign_partitions(keys, bits, FINE_BLOCK, first, last, partitions),
        block_count(n_corners, FINE_BLOCK),
        threads,
    )
    return group_items(partitions, 1 << bits, threads)


def first_of_equal_keys(keys: NDArray[np.uint64], threads: int) -> Indices:
    """For each row of ``keys``, uint64 [n, 2], the first row equal to it: [n]."""
    order, starts = _group_by_key(keys, threads)
    first_corners = np.empty_like(order)
    run_blocks(
        lambda first, last: _find_first_corners(keys, order, starts, first, last, first_corners),
        starts.size - 1,
        threads,
    )
    return first_corners


def _weld_corners(soup: PolygonSoup, threads: int) -> tuple[Floats, Indices, int, float]:
    """Vertices, the vertex of each corner, how many corners disagree with their vertex, and by how much at most."""
    first_corners = first_of_equal_keys(soup.keys, threads)
    n_blocks = block_count(first_corners.size, FINE_BLOCK)
    counts = np.zeros(n_blocks + 1, np.int64)
    run_blocks(lambda first, last: _count_vertices(first_corners, FINE_BLOCK, first, last, counts), n_blocks, threads)
    first_vertices = np.cumsum(counts)
    n_vertices = int(first_vertices[-1])
    vertices = np.empty((n_vertices, 3))
    corners = np.empty(first_corners.size, index_dtype(n_vertices))
    run_blocks(
        lambda first, last: _number_vertices(
            first_corners, soup.positions, FINE_BLOCK, first_vertices, first, last, corners, vertices
        ),
        n_blocks,
        threads,
    )
    tolerance = POSITION_AGREEMENT * max(float(vertices.max(initial=0.0)), -float(vertices.min(initial=0.0)))
    disagreements = np.zeros(n_blocks, np.int64)
    gaps = np.zeros(n_blocks)
    run_blocks(
        lambda first, last: _number_other_corners(
            first_corners,
            soup.positions,
            FINE_BLOCK,
            tolerance,
            first,
            last,
            corners,
            disagreements,
            gaps,
        ),
        n_blocks,
        threads,
    )
    return vertices, corners, int(disagreements.sum()), float(gaps.max(initial=0.0))


def weld(soup: PolygonSoup, *, threads: int | None = None) -> Surface:
    """Join the polygons of ``soup`` into a `Surface`.

    A vertex stands where its first corner in canonical order stands. The surface's ``report`` tells

    - ``position_disagreements``: corners further than `POSITION_AGREEMENT` (relative) from their vertex: a collision
      of keys or a degenerate arrangement;
    - ``max_position_disagreement``: the largest such distance (maximum norm), also when it is within the agreement.

    ``threads``: None takes all cores; the result is the same for any number. Raises ValueError for a malformed soup.
    """
    _check_soup(soup)
    threads = resolve_threads(threads)
    vertices, corners, disagreements, gap = _weld_corners(soup, threads)
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
