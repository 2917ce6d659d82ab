"""Moves a surface onto the level set of the true network: keeps the topology, turns no face over.

Vertices follow the gradient of the true network (`projection`). Faces that this turns over are turned back by sliding
vertices along the level set (`unfold`), else by going back the way they came. Then faces whose middle is too far from
the level set, which is curved, are divided (`subdivide`).

Where the gradients of the surrogate and of the true network are less than 90 degrees apart throughout, every mixture of
both has a gradient there, none of its level sets has a critical point, and both surfaces have the same topology
(Milnor, Morse Theory, theorem 3.1). Faces where that fails are counted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import resolve_threads
from mn_onnx.extract.measures import measure_polygons
from mn_onnx.extract.smooth.projection import Projection, TrueField
from mn_onnx.extract.smooth.subdivide import subdivide
from mn_onnx.extract.smooth.unfold import Neighbours, mean_over_corners, unfold
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

RETREATS = 12
"""Vertices of faces that stay turned over go half the way back this often, then all the way."""

FLATNESS = 1e-6
"""Faces are divided until their mean |f| is this part of the typical slope times half of the box."""

DIVISIONS = 8
"""Rounds of dividing faces; each makes |f| on them about four times smaller."""

MOST_GROWTH = 4.0
SMALL = 1 << 16
"""Dividing faces makes at most this many times as many polygons, or this many in all for a small mesh."""

MARGIN = 0.85
"""Faces are chosen so that their mean |f| is foretold to be this part of what is wanted."""


@dataclass(frozen=True)
class Polish:
    """What polishing did. ``f`` is the canonical value of the true network, zero on its level set.

    ``max_abs_f_before``, ``mean_abs_f_before``, ``max_abs_f``, ``mean_abs_f``: |f| over the vertices, before and after.
    ``vertices_within_1e_6``, ``vertices_within_1e_9``: how many have |f| of at most that after it.
    ``largest_move``: the farthest a vertex of the surface went. ``slid_vertices``: those moved along the level set to
    turn a face back. ``held_vertices``: those left short of the level set so that no face turns over.
    ``stray_vertices``: others that found no root within their reach. ``turned_polygons``, ``turned_area_share``: before
    it, the polygons whose gradient is more than 90 degrees from the true one; near these the topology need not be that
    of the true level set. ``reversed_polygons``: those among them that face against the true gradient afterwards.
    ``divided_polygons``: how many were divided to come closer to the curved level set.
    """

    max_abs_f_before: float
    mean_abs_f_before: float
    max_abs_f: float
    mean_abs_f: float
    vertices_within_1e_6: int
    vertices_within_1e_9: int
    largest_move: float
    slid_vertices: int
    held_vertices: int
    stray_vertices: int
    turned_polygons: int
    turned_area_share: float
    reversed_polygons: int
    divided_polygons: int


def polish(
    surface: Surface,
    network: Network,
    lower: Floats,
    upper: Floats,
    *,
    threads: int | None = None,
    flatness: float = FLATNESS,
) -> tuple[Surface, Polish]:
    """The surface with its vertices on the level set of the true functions of ``network``, and what was done.

    ``surface``: the level set of canonical ``network`` in the box ``lower``..``upper`` (float64 [3]). ``flatness``:
    faces are divided until their mean |f| is this part of the typical slope times half of the box (infinite: none
    is). The polygons of the result need not be flat; their gradients are those of the true network, the means of their
    corners'; ``errors`` and attributes are those of the polygons they come from.
    """
    threads = resolve_threads(threads)
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    projection = Projection.of(surface, TrueField(network, threads), lower, upper)
    before = np.abs(projection.values)
    upright = _facing(surface, projection, surface.vertices, threads) > 0
    projection.project(np.arange(surface.n_vertices))
    slid, held = _turn_back(surface, projection, upright, threads)
    stray = ~projection.settled()
    stray[held] = False
    moves = projection.positions - surface.vertices
    largest_move = float(np.sqrt((moves**2).sum(axis=1)).max())
    del moves
    moved = replace(surface, vertices=projection.positions.copy())
    wanted = flatness * projection.slope * 0.5 * float((upper - lower).max())
    result, divided, held_new = _divide(moved, projection, wanted, threads)
    result, reversed_polygons = _with_gradients(result, projection, threads)
    after = np.abs(projection.values)
    areas = surface.measures.areas
    return result, Polish(
        max_abs_f_before=float(before.max()),
        mean_abs_f_before=float(before.mean()),
        max_abs_f=float(after.max()),
        mean_abs_f=float(after.mean()),
        vertices_within_1e_6=int(np.count_nonzero(after <= 1e-6)),
        vertices_within_1e_9=int(np.count_nonzero(after <= 1e-9)),
        largest_move=largest_move,
        slid_vertices=int(slid.size),
        held_vertices=int(held.size) + held_new,
        stray_vertices=int(np.count_nonzero(stray)),
        turned_polygons=int(np.count_nonzero(~upright)),
        turned_area_share=float(areas[~upright].sum() / max(areas.sum(), np.finfo(np.float64).tiny)),
        reversed_polygons=reversed_polygons,
        divided_polygons=divided,
    )


def _turn_back(
    surface: Surface, projection: Projection, upright: NDArray[np.bool_], threads: int
) -> tuple[Integers, Integers]:
    """Turn back the faces that the projection turned over; returns the vertices that slid, and those held back.

    ``surface``: with the vertices where they were before. ``upright``: bool [p], the polygons that faced along the true
    gradient then; none of them stays turned over.
    """
    nobody = np.zeros(0, np.int64)
    folded = np.flatnonzero(_facing(surface, projection, projection.positions, threads) < 0)
    if not folded.size:
        return nobody, nobody
    neighbours = Neighbours.of(surface, threads)
    movable = np.asarray(projection.free.all(axis=1))

    def project(vertices: Integers) -> None:
        projection.evaluate(vertices)
        projection.project(vertices)

    folded, slid = unfold(neighbours, folded, projection.positions, projection.gradients, movable, project)
    folded = folded[upright[folded]]
    goals = projection.positions.copy()
    shares = np.ones(surface.n_vertices)
    retreats = 0
    while folded.size:
        back = neighbours.vertices_of(folded)
        back = back[shares[back] > 0]
        if not back.size:
            break
        shares[back] *= 0.5 if retreats < RETREATS else 0.0
        retreats += 1
        start = surface.vertices[back]
        projection.positions[back] = start + shares[back, None] * (goals[back] - start)
        projection.evaluate(back)
        touched = neighbours.polygons_at(back)
        touched = touched[upright[touched]]
        folded = touched[neighbours.facing(touched, projection.positions, projection.gradients) < 0]
    return slid, np.flatnonzero(shares < 1.0)


def _facing(surface: Surface, projection: Projection, positions: Floats, threads: int) -> Floats:
    """The area times the slope along the normal of each polygon, [p], at ``positions``: negative if turned over."""
    area_vectors = measure_polygons(positions, surface.offsets, surface.corners, threads).area_vectors
    gradients = mean_over_corners(projection.gradients, surface.offsets, surface.corners)
    return np.asarray(np.einsum("ij,ij->i", area_vectors, gradients))


def _divide(surface: Surface, projection: Projection, wanted: float, threads: int) -> tuple[Surface, int, int]:
    """Divide faces until the mean |f| at their middles is ``wanted``.

    Takes those with the largest |f|: where it is equal on all faces, their number is least for its mean. Faces with a
    vertex that is not on the level set are left alone: dividing them brings them no closer. Returns the surface, how
    many faces were divided, and how many new vertices were held back.
    """
    most = max(MOST_GROWTH * surface.n_polygons, SMALL)
    n_divided = n_held = 0
    for _ in range(DIVISIONS):
        middles = mean_over_corners(surface.vertices, surface.offsets, surface.corners)
        settled = np.minimum.reduceat(projection.settled()[surface.corners], surface.offsets[:-1])
        heights = np.where(settled, np.abs(projection.field.values(middles)), 0.0)
        order, needed = _highest(heights, surface.measures.areas, wanted)
        # A polygon of n corners becomes at most n.
        room = np.searchsorted(np.cumsum(surface.polygon_sizes[order]), most - surface.n_polygons, side="right")
        chosen = order[: min(needed, int(room))]
        if not chosen.size:
            break
        n_known = surface.n_vertices
        surface, free, numbers = subdivide(surface, chosen, projection.free, threads)
        projection.insert(numbers, surface.vertices, free)
        upright = _facing(surface, projection, surface.vertices, threads) > 0
        projection.project(np.flatnonzero(numbers >= n_known))
        _, held = _turn_back(surface, projection, upright, threads)
        surface = replace(surface, vertices=projection.positions.copy())
        n_divided += int(chosen.size)
        n_held += int(held.size)
    return surface, n_divided, n_held


def _highest(heights: Floats, areas: Floats, wanted: float) -> tuple[Integers, int]:
    """Polygons by falling |f|, and how many of them to divide so that its mean over the area becomes ``wanted``."""
    order = np.argsort(-heights, kind="stable")
    moments = (heights * areas)[order]
    excess = moments.sum() - MARGIN * wanted * areas.sum()
    if excess <= 0 or moments.sum() <= wanted * areas.sum():
        return order, 0
    # Dividing a face makes it half as wide, and its height a quarter.
    return order, int(np.searchsorted(0.75 * np.cumsum(moments), excess)) + 1


def _with_gradients(surface: Surface, projection: Projection, threads: int) -> tuple[Surface, int]:
    """The surface with the true gradients of its polygons, and the number of those that face against theirs."""
    gradients = mean_over_corners(projection.gradients, surface.offsets, surface.corners)
    area_vectors = measure_polygons(surface.vertices, surface.offsets, surface.corners, threads).area_vectors
    against = np.einsum("ij,ij->i", area_vectors, gradients) < 0
    gradients[against] *= -1
    return replace(surface, gradients=gradients), int(np.count_nonzero(against))
