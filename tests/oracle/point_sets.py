"""A surface as a set of points: what the oracle, which knows vertices by their positions, can be compared with."""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.surface import Surface
from oracle.level_set import LevelSet

DIGITS = 9


def point_set_counts(surface: Surface) -> tuple[int, int, int]:
    """Polygons, vertices and edges, where vertices at one place are one: a mesh keeps parts that touch there apart."""
    places, numbers = np.unique(np.round(surface.vertices, DIGITS) + 0.0, axis=0, return_inverse=True)
    tails = numbers.reshape(-1)[surface.corners]
    heads = half_edge_heads(surface.offsets, tails)
    edges = np.unique(np.sort(np.stack([tails, heads], axis=1), axis=1), axis=0)
    return surface.n_polygons, len(places), len(edges)


def exact_counts(exact: LevelSet) -> tuple[int, int, int]:
    """Polygons, vertices and edges."""
    return len(exact.facets), len(exact.vertices), exact.n_edges
