"""Marching cubes of a grid that onnxruntime evaluates, slab by slab, so that any grid fits in memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Evaluate = Callable[[Floats], Floats]

SLAB_SAMPLES = 1 << 25
"""Most values held at once: a grid of 256^3 is one slab, one of 512^3 is five."""
BLOCK_SAMPLES = 1 << 20
"""Most points made at once."""


class Cubes(NamedTuple):
    """``vertices`` float64 [v, 3] and ``triangles`` int64 [t, 3]; ``seconds`` of evaluate and triangulate.

    Where two slabs meet, each has vertices of its own: no triangle is lost or doubled, but they are not joined.
    """

    vertices: Floats
    triangles: NDArray[np.int64]
    seconds: dict[str, float]


def marching_cubes(evaluate: Evaluate, level: float, lower: Floats, upper: Floats, resolution: int) -> Cubes:
    """The level set of a field sampled at ``resolution``^3 points, the corners of the box among them.

    ``evaluate``: from points float64 [n, 3] to values [n]. ``lower``, ``upper``: float64 [3].
    """
    from skimage.measure import marching_cubes as lewiner

    axes = [np.linspace(low, high, resolution) for low, high in zip(lower, upper, strict=True)]
    spacing = (upper - lower) / (resolution - 1)
    layers = max(2, min(resolution, SLAB_SAMPLES // resolution**2))
    seconds = {"evaluate": 0.0, "triangulate": 0.0}
    parts: list[tuple[Floats, NDArray[np.int64]]] = []
    n_vertices = 0
    # Neighbouring slabs share a layer, as cubes lie between layers.
    for first in range(0, resolution - 1, layers - 1):
        started = time.perf_counter()
        values = _sample(evaluate, axes[0][first : first + layers], axes[1], axes[2])
        evaluated = time.perf_counter()
        seconds["evaluate"] += evaluated - started
        if values.min() <= level <= values.max():
            vertices, triangles, _, _ = lewiner(values, level, spacing=tuple(spacing))
            origin = np.array([axes[0][first], lower[1], lower[2]])
            parts.append((vertices.astype(np.float64) + origin, triangles.astype(np.int64) + n_vertices))
            n_vertices += len(vertices)
        seconds["triangulate"] += time.perf_counter() - evaluated
    if not parts:
        return Cubes(np.empty((0, 3)), np.empty((0, 3), np.int64), seconds)
    return Cubes(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([triangles for _, triangles in parts]),
        seconds,
    )


def _sample(evaluate: Evaluate, xs: Floats, ys: Floats, zs: Floats) -> NDArray[np.float32]:
    """Values float32 [xs, ys, zs] on the grid of three axes."""
    layer = ys.size * zs.size
    values = np.empty((xs.size, layer), np.float32)
    rows = max(1, BLOCK_SAMPLES // layer)
    for first in range(0, xs.size, rows):
        grid = np.meshgrid(xs[first : first + rows], ys, zs, indexing="ij", copy=False)
        points = np.stack(grid, axis=-1).reshape(-1, 3)
        values[first : first + rows] = evaluate(points).reshape(-1, layer)
    return values.reshape(xs.size, ys.size, zs.size)
