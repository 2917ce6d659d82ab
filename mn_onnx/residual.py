"""How far a mesh is from the level set: |f| at its vertices and at random points of its faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate, float64_error_bound
from mn_onnx.model import Model
from mn_onnx.runtime import Runtime

Floats = NDArray[np.float64]

FACE_SAMPLES = 1 << 16
MOST_VERTICES = 1 << 19
"""Larger meshes are measured at this many of their vertices, chosen at random."""

JUDGED_POINTS = 1 << 12
"""|f| is compared with its rounding bound, which costs more than |f|, at this many points where |f| is largest."""

POSITION_ROUNDINGS = 4
"""A vertex is a + s (b - a) along an edge: four roundings of each coordinate."""


@dataclass(frozen=True)
class Residuals:
    """|f| at vertices and random points of the faces, where f is zero on the level set.

    ``points``: how many of both. ``max_abs_f``, ``mean_abs_f``: over all, of the piecewise-linear f that was extracted,
    in float64. ``allowed_abs_f``: the largest |f| that rounding explains at any point judged; ``worst_ratio``: the
    largest ratio of |f| to what is explained at its own point. ``true_max_abs_f``, ``true_mean_abs_f``: over the points
    of the faces, of the original output minus the level, with the true activations. ``ort_mean_abs_f``: the same by
    ``runtime``, at points rounded to its precision; None where there is no comparison.
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
    vertices, samples = residual_points(surface, seed=seed)
    points = np.concatenate([vertices.points, samples.points])
    slopes = np.concatenate([vertices.slopes, samples.slopes])
    extracted = np.abs(evaluate(model.network, points))
    true = np.abs(model.evaluate(samples.points) - model.level)
    if position_error is None:
        largest = max(np.abs(model.lower).max(), np.abs(model.upper).max())
        position_error = POSITION_ROUNDINGS * np.finfo(np.float64).eps / 2 * largest
    judged = np.argsort(-extracted, kind="stable")[:JUDGED_POINTS]
    allowed = float64_error_bound(model.network, points[judged])
    allowed += slopes[judged] * position_error * np.sqrt(model.dimension)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(extracted[judged] == 0, 0.0, extracted[judged] / allowed)
    ort_mean = None
    if runtime is not None:
        asked = samples.points[: runtime.most_points]
        ort_mean = float(np.abs(runtime.evaluate(asked) - model.level).mean())
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


def true_residuals(model: Model, surface: Surface, *, seed: int = 0) -> dict[str, float]:
    """``true_max_abs_f`` and ``true_mean_abs_f``: |output - level| of the original network at points of the faces."""
    points, _ = sample_surface(surface, FACE_SAMPLES, seed=seed)
    true = np.abs(model.evaluate(points) - model.level)
    return {"true_max_abs_f": float(true.max()), "true_mean_abs_f": float(true.mean())}


class _Probe(NamedTuple):
    """Points float64 [n, dimension], and a bound of |grad f| around each, float64 [n]."""

    points: Floats
    slopes: Floats


def residual_points(surface: Surface, *, seed: int = 0) -> tuple[_Probe, _Probe]:
    """Vertices (all, or `MOST_VERTICES` of them), and random points of the faces, uniform by area."""
    steepness = np.linalg.norm(surface.gradients, axis=1)
    at_vertices = np.zeros(surface.n_vertices)
    np.maximum.at(at_vertices, surface.corners, np.repeat(steepness, surface.polygon_sizes))
    chosen = np.arange(surface.n_vertices)
    if chosen.size > MOST_VERTICES:
        chosen = np.random.default_rng(seed).choice(chosen, MOST_VERTICES, replace=False)
    samples, polygons = sample_surface(surface, FACE_SAMPLES, seed=seed)
    return _Probe(surface.vertices[chosen], at_vertices[chosen]), _Probe(samples, steepness[polygons])
