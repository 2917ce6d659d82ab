"""How good a mesh is: soft precision and soft recall (Stippel et al. 2025, section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.files import read_mesh
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.model import Model

Floats = NDArray[np.float64]

RECALL_SAMPLES = 1 << 17


def soft_precision(model: Model, surface: Surface, samples: int, *, seed: int = 0) -> float | None:
    """Mean |f - level| over ``samples`` random points of ``surface``, uniform by area; None if it has no area.

    The field is the original one, with its true activations, in float64.
    """
    if not surface.n_polygons or not surface.area > 0:
        return None
    points, _ = sample_surface(surface, samples, seed=seed)
    return float(np.abs(model.evaluate(points) - model.level).mean())


def reference_points(path: str, *, seed: int = 0) -> Floats:
    """`RECALL_SAMPLES` random points of a mesh file, uniform by area, float64 [n, 3].

    Raises `mn_onnx.extract.files.MeshFileError` or OSError for a file that holds no mesh.
    """
    return sample_surface(read_mesh(path), RECALL_SAMPLES, seed=seed)[0]


def soft_recall(points: Floats, surface: Surface) -> float | None:
    """Mean distance from ``points`` to the nearest point of ``surface``, exact; None for a surface without polygons."""
    import igl

    if not surface.n_polygons:
        return None
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.triangles().astype(np.int64))[0]
    return float(np.sqrt(squared).mean())
