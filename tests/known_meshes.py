"""Polygon meshes with known topology and measures, and polygon soups made from them."""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.surface import Surface

CUBE_VERTICES = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CUBE_POLYGONS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def flatten(polygons: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and corners of a list of polygons."""
    offsets = np.concatenate([[0], np.cumsum([len(polygon) for polygon in polygons])]).astype(np.int64)
    return offsets, np.array([vertex for polygon in polygons for vertex in polygon], np.int64)


def cube(side: float = 1.0, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Surface:
    offsets, corners = flatten(CUBE_POLYGONS)
    return Surface.from_polygons(CUBE_VERTICES * side + np.array(center), offsets, corners)


def joined(*surfaces: Surface) -> Surface:
    """Several surfaces as one mesh that shares no vertices among them."""
    first_vertices = np.cumsum([0] + [surface.n_vertices for surface in surfaces])
    first_corners = np.cumsum([0] + [surface.n_corners for surface in surfaces])
    return Surface.from_polygons(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([[0], *(s.offsets[1:] + first for s, first in zip(surfaces, first_corners, strict=False))]),
        np.concatenate([s.corners + first for s, first in zip(surfaces, first_vertices, strict=False)]),
    )


def inverted(surface: Surface) -> Surface:
    """The same mesh with every polygon turned over."""
    corners = np.concatenate([part[::-1] for part in np.split(surface.corners, surface.offsets[1:-1])])
    return Surface.from_polygons(surface.vertices, surface.offsets, corners)


def quad_grid(rows: int, columns: int, wrap: bool) -> np.ndarray:
    """Quads [n, 4] of a grid of vertices numbered row by row, closed to a torus where ``wrap``."""
    if wrap:
        i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        return np.stack(
            [
                i * columns + j,
                (i + 1) % rows * columns + j,
                (i + 1) % rows * columns + (j + 1) % columns,
                i * columns + (j + 1) % columns,
            ],
            axis=-1,
        ).reshape(-1, 4)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    corner = i * columns + j
    return np.stack([corner, corner + columns, corner + columns + 1, corner + 1], axis=-1).reshape(-1, 4)


def torus(rows: int = 24, columns: int = 12, major: float = 0.6, minor: float = 0.2) -> Surface:
    """A torus of quads around the z axis, seen from outside."""
    u, v = np.meshgrid(2 * np.pi * np.arange(rows) / rows, 2 * np.pi * np.arange(columns) / columns, indexing="ij")
    radius = major + minor * np.cos(v)
    vertices = np.stack([radius * np.cos(u), radius * np.sin(u), minor * np.sin(v)], axis=-1).reshape(-1, 3)
    quads = quad_grid(rows, columns, wrap=True)
    return Surface.from_polygons(vertices, np.arange(len(quads) + 1) * 4, quads.reshape(-1))


def sheet(rows: int = 5, columns: int = 7) -> Surface:
    """A flat open grid over [-1, 1]^2 at z = 0, facing up; its boundary is on the box [-1, 1]^3."""
    x, y = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    quads = quad_grid(rows, columns, wrap=False)
    return Surface.from_polygons(vertices, np.arange(len(quads) + 1) * 4, quads.reshape(-1))


def soup_of(surface: Surface, seed: int = 0, noise: float = 0.0) -> PolygonSoup:
    """The surface taken apart: a random 128-bit key per vertex, polygons in random order, corners off by ``noise``.

    Every corner has a point of its own.
    """
    generator = np.random.default_rng(seed)
    keys = generator.integers(0, 2**64, (surface.n_vertices, 2), np.uint64)
    order = generator.permutation(surface.n_polygons)
    sizes = surface.polygon_sizes[order]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    source = np.arange(offsets[-1]) + np.repeat(surface.offsets[order] - offsets[:-1], sizes)
    corners = surface.corners[source]
    positions = surface.vertices[corners] + noise * generator.uniform(-1, 1, (corners.size, 3))
    return PolygonSoup(
        offsets=offsets,
        corners=np.arange(corners.size),
        positions=positions,
        keys=keys[corners],
        box_faces=surface.box_faces[source],
        gradients=surface.gradients[order],
        errors=surface.errors[order],
    )
