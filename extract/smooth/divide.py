"""Divides the faces of a polished mesh that are too far from the curved level set between their corners."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.smooth.faces import facing, mean_over_corners
from mn_onnx.extract.smooth.projection import Projection
from mn_onnx.extract.smooth.subdivide import Division, subdivide
from mn_onnx.extract.smooth.unfold import turn_back
from mn_onnx.extract.surface import Surface

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

DIVISIONS = 8
"""Rounds of dividing faces; each makes |f| on them about four times smaller."""

MOST_GROWTH = 6.0
SMALL = 1 << 18
"""Dividing faces makes at most this many times as many polygons, or this many in all for a small mesh."""

SAMPLES = 1 << 15
"""Random points by which the mean over faces is compared with that of their middles: 3/4 where faces are triangles and
|f| quadratic (exactly), more where the network has creases."""

PART = 0.25
"""|f| in the middle of a part of a face by that of the face."""

MARGIN = 0.85
"""Faces are divided so that their mean |f| is foretold to be this part of what is wanted."""

LEAST_LIMIT = 2.0**-100

WORTH = 0.25
"""|f| is evaluated on faces whose foretold moment is at least this part of those that were divided."""


def divide(
    surface: Surface, projection: Projection, wanted: float, most_polygons: float, threads: int
) -> tuple[Surface, int]:
    """Divide faces until the mean |f| over them is ``wanted``, or they are about ``most_polygons``.

    ``surface``, with vertices as in ``projection``, which are brought up to date. Faces with a vertex that is not on
    the level set are left alone: dividing them brings them no closer. Returns the surface, and how many faces were
    divided.
    """
    most = min(max(MOST_GROWTH * surface.n_polygons, SMALL), most_polygons)
    n_divided = 0
    # f in the middle of each face, NaN where it is not evaluated, and its foretold size, NaN where it must be.
    middle, foretold = np.full(surface.n_polygons, np.nan), np.full(surface.n_polygons, np.nan)
    limit = 0.0
    for _ in range(DIVISIONS):
        areas = surface.measures.areas
        unknown = np.flatnonzero(np.isnan(middle) & ~(foretold * areas <= WORTH * limit))
        middle[unknown] = projection.field.values(
            mean_over_corners(surface.vertices, surface.offsets, surface.corners, unknown)
        )
        heights = np.where(np.isnan(middle), foretold, np.abs(middle))
        settled = np.logical_and.reduceat(projection.settled()[surface.corners], surface.offsets[:-1])
        moments = np.where(settled, heights, 0.0) * areas
        of_middles = float(moments.sum()) / max(float(areas.sum()), np.finfo(np.float64).tiny)
        points, polygons = sample_surface(surface, SAMPLES)
        of_faces = float((np.abs(projection.field.values(points)) * settled[polygons]).mean())
        goal = wanted * of_middles / max(of_faces, np.finfo(np.float64).tiny)
        chosen, limit = _to_divide(moments, goal * float(areas.sum()))
        # A polygon of n corners becomes at most n.
        room = np.searchsorted(np.cumsum(surface.polygon_sizes[chosen]), most - surface.n_polygons, side="right")
        full, chosen = room < chosen.size, chosen[:room]
        if not chosen.size:
            break
        division = subdivide(surface, chosen, projection.free, projection.gradients, threads)
        surface, moved = _project(division, middle, projection, threads)
        heights[chosen] *= PART
        foretold, middle = heights[division.parents], middle[division.parents]
        middle[~division.whole] = np.nan
        touched = np.logical_or.reduceat(moved[surface.corners], surface.offsets[:-1])
        middle[touched] = foretold[touched] = np.nan
        n_divided += int(chosen.size)
        if full:
            break
    return surface, n_divided


def _project(
    division: Division, middle: Floats, projection: Projection, threads: int
) -> tuple[Surface, NDArray[np.bool_]]:
    """Bring the new vertices onto the level set.

    ``middle``: [p], f in the middle of each of the polygons before. Returns the surface, and bool [v] which vertices
    slid or were held back.
    """
    surface = division.surface
    new = np.flatnonzero(division.order >= len(projection.values))
    values = np.where(division.centre_of >= 0, middle[division.centre_of], np.nan)
    projection.insert(division.order, surface.vertices[new], values, division.carried, division.free)
    everywhere = np.arange(surface.n_polygons)
    upright = facing(surface.vertices, projection.gradients, surface.offsets, surface.corners, everywhere) > 0
    projection.project(new)
    slid, held = turn_back(surface, projection, upright, np.flatnonzero(~division.whole), threads)
    moved = np.zeros(surface.n_vertices, bool)
    moved[slid] = moved[held] = True
    return replace(surface, vertices=projection.positions.copy()), moved


def _to_divide(moments: Floats, wanted: float) -> tuple[Integers, float]:
    """The polygons to divide so that their ``moments``, |f| times the area, come to ``wanted`` in all, largest first.

    Each division of a polygon in four takes three quarters of its moment away, so those with the largest are divided,
    and their parts again, until no part has more than a limit that all have in common. Returns that limit too.
    """
    order = np.argsort(-moments, kind="stable").astype(np.int64)
    falling = moments[order]
    sums = np.concatenate([np.zeros(1), np.cumsum(falling)])
    # Not so also where a moment is not a number.
    if not sums[-1] > wanted or falling[0] * LEAST_LIMIT <= np.finfo(np.float64).tiny:
        return order[:0], 0.0
    parts = PART / 4.0

    def left(limit: float) -> float:
        """The sum after dividing all above ``limit``."""
        powers = parts ** -np.arange(math.ceil(math.log(falling[0] / limit) / -math.log(parts)) + 1)
        ends = np.searchsorted(-falling, -limit * powers)
        of_rounds = np.diff(sums[ends[::-1]])[::-1] if ends.size > 1 else np.zeros(0)
        return float(sums[-1] - sums[ends[0]] + (of_rounds * PART ** np.arange(1, ends.size)).sum())

    low, high = float(falling[0]) * LEAST_LIMIT, float(falling[0])
    while high > 1.001 * low:
        limit = math.sqrt(low * high)
        low, high = (limit, high) if left(limit) <= MARGIN * wanted else (low, limit)
    return order[: np.searchsorted(-falling, -low)], low
