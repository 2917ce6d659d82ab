"""Level sets of networks over two coordinates and over one, by way of the prism and the slab over them.

The network is extended to three dimensions on which it does not depend. Its level set there is the prism of the curve,
a polygon per segment, or a square per root; what is sought is its rim on the lower face of the box.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.pipeline import Extraction, RunOptions, extract_surface
from mn_onnx.extract.planar.curve import Curve, Roots
from mn_onnx.extract.planar.embed import embed
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

LOWER_Z = 4  # the box face that holds the rim of a prism


@dataclass(frozen=True, eq=False)
class CurveExtraction:
    """The level set of a network over two coordinates, and the extraction of the prism over it."""

    curve: Curve
    prism: Extraction


@dataclass(frozen=True, eq=False)
class RootExtraction:
    """The level set of a network over one coordinate, and the extraction of the squares over it."""

    roots: Roots
    slab: Extraction


def extract_curve(network: Network, lower: Floats, upper: Floats, **options: Unpack[RunOptions]) -> CurveExtraction:
    """The level set f = 0 of a canonical network over two coordinates, in the box ``lower``..``upper`` (float64 [2]).

    Arguments, convention and errors as in `extract_surface`; ``curve.problems()`` tells if it does not close.
    """
    _check_dimension(network, 2)
    wide, low, high = embed(network, lower, upper)
    prism = extract_surface(wide, low, high, **options)
    surface = _inside_the_box(prism)
    rim = np.flatnonzero((surface.twins < 0) & (surface.box_faces == LOWER_Z))
    ends = np.stack([surface.corners[rim], half_edge_heads(surface.offsets, surface.corners)[rim]], axis=1)
    used, numbers = np.unique(ends, return_inverse=True)
    polygons = np.searchsorted(surface.offsets, rim, side="right") - 1
    curve = Curve.from_segments(
        surface.vertices[used, :2],
        numbers.reshape(-1, 2).astype(np.int64),
        surface.gradients[polygons, :2],
        surface.errors[polygons],
        low[:2],
        high[:2],
    )
    return CurveExtraction(curve, prism)


def extract_roots(network: Network, lower: Floats, upper: Floats, **options: Unpack[RunOptions]) -> RootExtraction:
    """The level set f = 0 of a canonical network over one coordinate between ``lower`` and ``upper`` (float64 [1]).

    Arguments, convention and errors as in `extract_surface`.
    """
    _check_dimension(network, 1)
    wide, low, high = embed(network, lower, upper)
    slab = extract_surface(wide, low, high, **options)
    surface = _inside_the_box(slab)
    positions = surface.vertices[surface.corners[surface.offsets[:-1]], 0]
    slopes = surface.gradients[:, 0]
    is_below = bool(evaluate(network, low[None, :1])[0] < 0)
    order = _alternating(positions, slopes, is_below, slab.coincidence)
    roots = Roots(np.sort(positions), slopes[order], surface.errors[order], float(low[0]), float(high[0]))
    return RootExtraction(roots, slab)


def _alternating(positions: Floats, slopes: Floats, is_below: bool, apart: float) -> NDArray[np.int64]:
    """The order of roots along the axis, which f crosses from below and from above by turns.

    Of two roots not ``apart``, as where f only touches zero, rounding does not tell which is the first. ``is_below``:
    whether f is negative before the first root.
    """
    order = np.argsort(positions, kind="stable")
    for first in range(order.size - 1):
        here, there = order[first : first + 2]
        turned = (slopes[here] > 0) != is_below and (slopes[there] > 0) == is_below
        if turned and positions[there] - positions[here] <= apart:
            order[first], order[first + 1] = there, here
        is_below = not slopes[order[first]] > 0
    return order


def _inside_the_box(extraction: Extraction) -> Surface:
    """The surface, without polygons if all it has are copies of box faces: the border of the box is no curve of f."""
    if not extraction.degeneracy.only_box_copies:
        return extraction.surface
    return Surface.from_polygons(np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int64))


def _check_dimension(network: Network, dimension: int) -> None:
    if network.input_dim != dimension:
        raise ValueError(f"the network has {network.input_dim} inputs where {dimension} are needed")
