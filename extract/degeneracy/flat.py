"""Regions where f is zero throughout: the level set is solid there, and no surface shows its whole extent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import resolve_threads, run_matrix_parts
from mn_onnx.extract.surface import Surface, unit_vectors
from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

N_INSIDE = 4096
"""Random points of the box that are looked at."""

N_BESIDE = 1024
"""Polygons of the surface beside which is looked."""

BLOCK = 512
"""Points that are evaluated together."""

STEP = 1e-6
"""How far from its polygon a point beside the surface lies, relative to the box."""

ROUNDING = 1e-12
"""Values up to this, relative to the largest one in the box, are zero; so are slopes that reach no more across it."""


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


def find_flat_regions(
    network: Network, lower: Floats, upper: Floats, surface: Surface, *, threads: int | None = None
) -> FlatRegions:
    """Look for regions of zeros at random points of the box (the same in every call) and just outside the surface.

    ``lower``, ``upper``: float64 [3]. ``threads``: None takes all cores.
    """
    generator = np.random.default_rng(0)
    evaluator = Evaluator(network)
    inside = generator.uniform(lower, upper, (N_INSIDE, network.input_dim))
    values = _values(evaluator, inside, threads)
    size = float((upper - lower).max())
    largest = float(np.abs(values).max()) or 1.0
    share = _flat_share(evaluator, inside, values, largest, size)
    if not surface.n_polygons:
        return FlatRegions(share)
    polygons = np.linspace(0, surface.n_polygons - 1, min(N_BESIDE, surface.n_polygons)).astype(np.int64)
    beside = surface.centres(polygons) + STEP * size * unit_vectors(surface.gradients[polygons])
    return FlatRegions(share, _flat_share(evaluator, beside, _values(evaluator, beside, threads), largest, size))


def _values(evaluator: Evaluator, points: Floats, threads: int | None) -> Floats:
    """``f`` at ``points``, on threads of ours.

    Those of numpy's matrix products keep a core busy for some 30 ms after the last one, and a traversal that begins
    then would share it.
    """
    values = np.empty(len(points))

    def work(part: slice) -> None:
        values[part] = evaluator.values(points[part])

    run_matrix_parts(work, len(points), BLOCK, resolve_threads(threads))
    return values


def _flat_share(evaluator: Evaluator, points: Floats, values: Floats, largest: float, size: float) -> float:
    """The part of ``points`` where both ``values`` and gradients are zero."""
    zeros = points[np.abs(values) <= ROUNDING * largest]
    flat = (np.abs(evaluator.gradients(zeros)) * size <= ROUNDING * largest).all(axis=1)
    return int(np.count_nonzero(flat)) / len(points)
