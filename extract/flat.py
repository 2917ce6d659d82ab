"""Regions where f is zero throughout: the level set is solid there, and no surface shows its whole extent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate, gradient
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

N_SAMPLES = 4096
"""Points of the box, and polygons of the surface, that are looked at."""

STEP = 1e-6
"""How far from its polygon a point beside the surface lies, relative to the box."""

ROUNDING = 1e-12
"""Values and slopes up to this, relative to the steepest slope times the box, are zero."""


@dataclass(frozen=True)
class FlatRegions:
    """What was found of regions where f is zero throughout, by sampling.

    ``share``: the part of the random points of the box that lie in such a region. ``bordering``: the part of the
    sampled polygons of the surface that such a region adjoins.
    """

    share: float = 0.0
    bordering: float = 0.0

    def __bool__(self) -> bool:
        return self.share > 0 or self.bordering > 0


def find_flat_regions(network: Network, lower: Floats, upper: Floats, surface: Surface) -> FlatRegions:
    """Look for regions of zeros at random points of the box (the same in every call) and just outside the surface.

    ``lower``, ``upper``: float64 [3].
    """
    generator = np.random.default_rng(0)
    inside = generator.uniform(lower, upper, (N_SAMPLES, network.input_dim))
    size = float((upper - lower).max())
    beside = np.zeros((0, network.input_dim))
    if surface.n_polygons:
        polygons = np.linspace(0, surface.n_polygons - 1, min(N_SAMPLES, surface.n_polygons)).astype(np.int64)
        beside = _centres(surface)[polygons] + STEP * size * surface.normals[polygons]
    steepest = max(np.abs(gradient(network, inside)).max(initial=0.0), np.abs(surface.gradients).max(initial=0.0))
    share, bordering = (_zero_share(network, points, float(steepest), size) for points in (inside, beside))
    return FlatRegions(share, bordering)


def _centres(surface: Surface) -> Floats:
    sums = np.add.reduceat(surface.vertices[surface.corners], surface.offsets[:-1], axis=0)
    return np.asarray(sums / surface.polygon_sizes[:, None])


def _zero_share(network: Network, points: Floats, steepest: float, size: float) -> float:
    """The part of ``points`` where value and gradient are zero."""
    if not len(points):
        return 0.0
    zeros = points[np.abs(evaluate(network, points)) <= ROUNDING * steepest * size]
    flat = (np.abs(gradient(network, zeros)) <= ROUNDING * steepest).all(axis=1)
    return int(np.count_nonzero(flat)) / len(points)
