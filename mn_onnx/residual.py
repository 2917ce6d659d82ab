"""How far a mesh is from the level set: |f| at its vertices and at random points of its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate, float64_error_bound
from mn_onnx.model import Model
from mn_onnx.runtime import Runtime

Floats = NDArray[np.float64]

FACE_SAMPLES = 1 << 17
MOST_VERTICES = 1 << 19
"""Larger meshes are measured at this many of their vertices, chosen at random."""

POSITION_ROUNDINGS = 4
"""A vertex is a + s (b - a) along an edge: four roundings of each coordinate."""


@dataclass(frozen=True)
class Residuals:
    """|f| over the points measured, where f is zero on the level set.

    ``points``: how many. ``max_abs_f``, ``mean_abs_f``: of the piecewise-linear f that was extracted, in float64.
    ``allowed_abs_f``: the largest |f| that rounding explains at any point; ``worst_ratio``: the largest ratio of |f| to
    what is explained at its own point. ``true_max_abs_f``, ``true_mean_abs_f``: of the original output minus the
    level, with the true activations. ``ort_mean_abs_f``: the same by ``runtime``, on points rounded to its precision;
    None where there is no comparison.
    """

    points: int
    max_abs_f: float
    mean_abs_f: float
    allowed_abs_f: float
    worst_ratio: float
    true_max_abs_f: float
    true_mean_abs_f: float
    ort_mean_abs_f: float | None


def measure_residuals(
    model: Model,
    surface: Surface,
    runtime: Runtime | None,
    *,
    position_error: float | None = None,
    seed: int = 0,
) -> Residuals:
    """Measure ``surface``, which must have an area.

    ``position_error``: how far a stored coordinate may be from the true one (default: float64 rounding within the box).
    ``runtime``: the program to ask besides, or None.
    """
    points, slopes = residual_points(surface, seed=seed)
    extracted = np.abs(evaluate(model.network, points))
    true = np.abs(model.evaluate(points) - model.level)
    if position_error is None:
        largest = max(np.abs(model.lower).max(), np.abs(model.upper).max())
        position_error = POSITION_ROUNDINGS * np.finfo(np.float64).eps / 2 * largest
    allowed = float64_error_bound(model.network, points) + slopes * position_error * np.sqrt(model.dimension)
    ort_mean = None
    if runtime is not None:
        asked = points
        if len(points) > runtime.most_points:
            asked = np.random.default_rng(seed).choice(points, runtime.most_points, replace=False)
        ort_mean = float(np.abs(runtime.evaluate(asked) - model.level).mean())
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(extracted == 0, 0.0, extracted / allowed)
    return Residuals(
        points=len(points),
        max_abs_f=float(extracted.max()),
        mean_abs_f=float(extracted.mean()),
        allowed_abs_f=float(allowed.max()),
        worst_ratio=float(ratio.max()),
        true_max_abs_f=float(true.max()),
        true_mean_abs_f=float(true.mean()),
        ort_mean_abs_f=ort_mean,
    )


def residual_points(surface: Surface, *, seed: int = 0) -> tuple[Floats, Floats]:
    """Vertices, then area-weighted samples: points float64 [n, dim], and a bound of |grad f| at each, float64 [n]."""
    steepness = np.linalg.norm(surface.gradients, axis=1)
    at_vertices = np.zeros(surface.n_vertices)
    np.maximum.at(at_vertices, surface.corners, np.repeat(steepness, surface.polygon_sizes))
    chosen = np.arange(surface.n_vertices)
    if chosen.size > MOST_VERTICES:
        chosen = np.random.default_rng(seed).choice(chosen, MOST_VERTICES, replace=False)
    samples, polygons = sample_surface(surface, FACE_SAMPLES, seed=seed)
    points = np.concatenate([surface.vertices[chosen], samples])
    return points, np.concatenate([at_vertices[chosen], steepness[polygons]])
