"""Means over the corners of faces, and whether faces lie along or against the gradient there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@threaded_kernel
def _means(of_vertices: Floats, offsets: Integers, corners: Indices, polygons: Integers, means: Floats) -> None:
    for place in range(polygons.size):
        begin, end = offsets[polygons[place]], offsets[polygons[place] + 1]
        for axis in range(means.shape[1]):
            total = 0.0
            for corner in range(begin, end):
                total += of_vertices[corners[corner], axis]
            means[place, axis] = total / (end - begin)


@threaded_kernel
def _facing(
    positions: Floats, gradients: Floats, offsets: Integers, corners: Indices, polygons: Integers, result: Floats
) -> None:
    for place in range(polygons.size):
        begin, end = offsets[polygons[place]], offsets[polygons[place] + 1]
        origin, previous = corners[begin], corners[end - 1]
        gx = gy = gz = ax = ay = az = 0.0
        px = positions[previous, 0] - positions[origin, 0]
        py = positions[previous, 1] - positions[origin, 1]
        pz = positions[previous, 2] - positions[origin, 2]
        for corner in range(begin, end):
            vertex = corners[corner]
            qx = positions[vertex, 0] - positions[origin, 0]
            qy = positions[vertex, 1] - positions[origin, 1]
            qz = positions[vertex, 2] - positions[origin, 2]
            ax += py * qz - pz * qy
            ay += pz * qx - px * qz
            az += px * qy - py * qx
            gx += gradients[vertex, 0]
            gy += gradients[vertex, 1]
            gz += gradients[vertex, 2]
            px, py, pz = qx, qy, qz
        result[place] = 0.5 * (ax * gx + ay * gy + az * gz) / (end - begin)


def mean_over_corners(of_vertices: Floats, offsets: Integers, corners: Indices, polygons: Integers) -> Floats:
    """The mean of ``of_vertices`` [v, k] over the corners of each of ``polygons`` (int64 [n]), float64 [n, k]."""
    means = np.empty((polygons.size, of_vertices.shape[1]))
    _means(of_vertices, offsets, corners, polygons, means)
    return means


def facing(positions: Floats, gradients: Floats, offsets: Integers, corners: Indices, polygons: Integers) -> Floats:
    """The area of each of ``polygons`` (int64 [n]) times the slope along its normal, float64 [n].

    Negative where it is turned over. ``positions``, ``gradients``: float64 [v, 3]; a polygon's gradient is the mean of
    its corners'.
    """
    result = np.empty(polygons.size)
    _facing(positions, gradients, offsets, corners, polygons, result)
    return result
