"""Area, volume and extent of every polygon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import FINE_BLOCK, Indices, block_count, run_blocks
from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]


@threaded_kernel
def lengths(vectors: Floats) -> Floats:
    """Lengths [n] of vectors [n, 3]."""
    result = np.empty(vectors.shape[0])
    for i in range(result.size):
        result[i] = np.sqrt(vectors[i, 0] ** 2 + vectors[i, 1] ** 2 + vectors[i, 2] ** 2)
    return result


@dataclass(frozen=True, eq=False)
class PolygonMeasures:
    """What is measured on each of ``p`` polygons.

    ``area_vectors``: float64 [p, 3], of the length of the area and the direction of the normal that the corners'
    order gives. ``areas``: float64 [p], their lengths.
    ``volumes``: float64 [p], the signed volume of the cone from a common point; their sum over a closed component is
    the volume inside it.
    ``perimeters``, ``shortest_edges``: float64 [p].
    """

    area_vectors: Floats
    areas: Floats
    volumes: Floats
    perimeters: Floats
    shortest_edges: Floats


@threaded_kernel
def _measure(
    vertices: Floats,
    offsets: NDArray[np.int64],
    corners: Indices,
    centre: Floats,
    block_size: int,
    first: int,
    last: int,
    area_vectors: Floats,
    areas: Floats,
    volumes: Floats,
    perimeters: Floats,
    shortest_edges: Floats,
) -> None:
    for polygon in range(first * block_size, min(last * block_size, offsets.size - 1)):
        begin, end = offsets[polygon], offsets[polygon + 1]
        origin = corners[begin]
        ax = ay = az = perimeter = 0.0
        shortest = np.inf
        previous = corners[end - 1]
        px, py, pz = (
            vertices[previous, 0] - vertices[origin, 0],
            vertices[previous, 1] - vertices[origin, 1],
            vertices[previous, 2] - vertices[origin, 2],
        )
        for corner in range(begin, end):
            vertex = corners[corner]
            qx, qy, qz = (
                vertices[vertex, 0] - vertices[origin, 0],
                vertices[vertex, 1] - vertices[origin, 1],
                vertices[vertex, 2] - vertices[origin, 2],
            )
            ax += 0.5 * (py * qz - pz * qy)
            ay += 0.5 * (pz * qx - px * qz)
            az += 0.5 * (px * qy - py * qx)
            length = np.sqrt((qx - px) ** 2 + (qy - py) ** 2 + (qz - pz) ** 2)
            perimeter += length
            shortest = min(shortest, length)
            px, py, pz = qx, qy, qz
        area_vectors[polygon, 0] = ax
        area_vectors[polygon, 1] = ay
        area_vectors[polygon, 2] = az
        areas[polygon] = np.sqrt(ax**2 + ay**2 + az**2)
        volumes[polygon] = (
            ax * (vertices[origin, 0] - centre[0])
            + ay * (vertices[origin, 1] - centre[1])
            + az * (vertices[origin, 2] - centre[2])
        ) / 3.0
        perimeters[polygon] = perimeter
        shortest_edges[polygon] = shortest


def measure_polygons(vertices: Floats, offsets: NDArray[np.int64], corners: Indices, threads: int) -> PolygonMeasures:
    """Measure planar polygons: ``vertices`` [v, 3], ``offsets`` int64 [p + 1], ``corners`` [c] vertex indices."""
    n_polygons = offsets.size - 1
    measures = PolygonMeasures(np.empty((n_polygons, 3)), *(np.empty(n_polygons) for _ in range(4)))
    if n_polygons:
        # Column by column: numpy is several times slower along the long axis of a table.
        centre = np.array([0.5 * (column.min() + column.max()) for column in vertices.T])
        run_blocks(
            lambda first, last: _measure(
                vertices,
                offsets,
                corners,
                centre,
                FINE_BLOCK,
                first,
                last,
                measures.area_vectors,
                measures.areas,
                measures.volumes,
                measures.perimeters,
                measures.shortest_edges,
            ),
            block_count(n_polygons, FINE_BLOCK),
            threads,
        )
    return measures
