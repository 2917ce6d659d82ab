"""How far a mesh is from the level set: |f| at its vertices and at random points of its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.checks.runtime import Runtime
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate, float64_error_bound, gradient
from mn_onnx.model import Model

Floats = NDArray[np.float64]

FACE_SAMPLES = 1 << 15
"""Points of the faces: the standard error of mean |f| is 0.6 % of its standard deviation."""

MOST_VERTICES = 1 << 15
"""An extraction measures this many of its vertices, chosen at random: a fault of one vertex in 5,000 escapes it with a
probability of exp(-6.5), or 0.15 %. `mn_onnx.checks.verification.verify` measures them all."""

JUDGED_POINTS = 1 << 10
"""|f| is compared with its rounding bound, which costs more than |f|, at this many points where |f| is largest."""

POSITION_ROUNDINGS = 4
"""A vertex is a + s (b - a) along an edge: four roundings of each coordinate."""


@dataclass(frozen=True)
class Residuals:
    """|f| at vertices and random points of the faces, where f is zero on the level set.

    ``points``: how many of both; of a large mesh not all vertices, see `MOST_VERTICES`. ``max_abs_f``, ``mean_abs_f``:
    over all, of the piecewise-linear f that was extracted, in float64. ``allowed_abs_f``: the largest |f| that rounding
    explains at any point judged; ``worst_ratio``: the largest ratio of |f| to what is explained at its own point.
    ``true_max_abs_f``, ``true_mean_abs_f``: over the points of the faces, of the original output minus the level, with
    the true activations. ``ort_mean_abs_f``: the same by ``runtime``, at points rounded to its precision; None where
    there is no comparison.
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
    most_vertices: int | None = MOST_VERTICES,
    seed: int = 0,
) -> Residuals:
    """Measure ``surface``, which must have an area.

    ``position_error``: how far a coordinate may be from the true one (None: by float64 rounding within the box).
    ``most_vertices``: how many to measure at most, None for all. ``runtime``: the program to ask besides, or None.
    """
    vertices = np.flatnonzero(np.bincount(surface.corners))
    if most_vertices is not None and vertices.size > most_vertices:
        vertices = np.random.default_rng(seed).choice(vertices, most_vertices, replace=False)
    samples, polygons = sample_surface(surface, FACE_SAMPLES, seed=seed)
    points = np.concatenate([surface.vertices[vertices], samples])
    extracted = np.abs(evaluate(model.network, points))
    true = np.abs(model.evaluate(samples) - model.level)
    if position_error is None:
        position_error = position_rounding(model)
    judged = np.argsort(-extracted, kind="stable")[:JUDGED_POINTS]
    allowed = float64_error_bound(model.network, points[judged])
    slopes = np.empty(judged.size)
    at_vertex = judged < vertices.size
    slopes[at_vertex] = _slopes_around(model, surface, vertices[judged[at_vertex]])
    slopes[~at_vertex] = _slopes_on(model, surface, polygons[judged[~at_vertex] - vertices.size])
    allowed += slopes * position_error * np.sqrt(model.dimension)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(extracted[judged] == 0, 0.0, extracted[judged] / allowed)
    ort_mean = None
    if runtime is not None:
        asked = samples[: runtime.most_points]
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


def position_rounding(model: Model) -> float:
    """How far float64 rounding may have moved a coordinate of an extracted vertex."""
    largest = max(np.abs(model.lower).max(), np.abs(model.upper).max())
    return float(POSITION_ROUNDINGS * np.finfo(np.float64).eps / 2 * largest)


def true_residuals(model: Model, surface: Surface, *, seed: int = 0) -> dict[str, float]:
    """``true_max_abs_f`` and ``true_mean_abs_f``: |output - level| of the original network at points of the faces."""
    points, _ = sample_surface(surface, FACE_SAMPLES, seed=seed)
    true = np.abs(model.evaluate(points) - model.level)
    return {"true_max_abs_f": float(true.max()), "true_mean_abs_f": float(true.mean())}


def _slopes_on(model: Model, surface: Surface, polygons: NDArray[np.int64]) -> Floats:
    """|grad f| at the centres of ``polygons``, float64 [n]: asked of the network, as meshes from files do not tell."""
    if not polygons.size:
        return np.zeros(0)
    return np.asarray(np.linalg.norm(gradient(model.network, surface.centres(polygons)), axis=1))


def _slopes_around(model: Model, surface: Surface, vertices: NDArray[np.int64]) -> Floats:
    """The largest |grad f| on the polygons around each of ``vertices``, which are different, float64 [n]."""
    places = np.full(surface.n_vertices, -1)
    places[vertices] = np.arange(vertices.size)
    corners = np.flatnonzero(places[surface.corners] >= 0)
    polygons, of_corners = np.unique(np.searchsorted(surface.offsets, corners, side="right") - 1, return_inverse=True)
    slopes = np.zeros(vertices.size)
    np.maximum.at(slopes, places[surface.corners[corners]], _slopes_on(model, surface, polygons)[of_corners])
    return slopes
