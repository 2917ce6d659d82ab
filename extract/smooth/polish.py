"""Moves a surface onto the level set of the true network: keeps the topology, turns no face over.

Vertices follow the gradient of the true network (`projection`). Faces that this turns over are turned back by sliding
vertices along the level set (`unfold`), else by going back the way they came. Then faces whose middle is too far from
the level set, which is curved, are divided (`divide`).

Where the gradients of the surrogate and of the true network are less than 90 degrees apart throughout, every mixture of
both has a gradient there, none of its level sets has a critical point, and both surfaces have the same topology
(Milnor, Morse Theory, theorem 3.1). Faces where that fails are counted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import resolve_threads
from mn_onnx.extract.smooth.divide import divide
from mn_onnx.extract.smooth.faces import facing, mean_over_corners
from mn_onnx.extract.smooth.projection import Projection, TrueField
from mn_onnx.extract.smooth.unfold import turn_back
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

FLATNESS = 1e-6
"""Faces are divided until their mean |f| is this part of the typical slope times half of the box."""


@dataclass(frozen=True)
class Polish:
    """What polishing did. ``f`` is the canonical value of the true network, zero on its level set.

    ``max_abs_f_before``, ``mean_abs_f_before``, ``max_abs_f``, ``mean_abs_f``: |f| over the vertices, before and after.
    ``vertices_within_1e_6``, ``vertices_within_1e_9``: how many have |f| of at most that after it.
    ``largest_move``: the farthest a vertex of the surface went. ``slid_vertices``: those moved along the level set to
    turn a face back. ``held_vertices``: those left short of the level set so that no face turns over.
    ``stray_vertices``: others that found no root within their reach. ``turned_polygons``, ``turned_area_share``: before
    it, the polygons whose gradient is more than 90 degrees from the true one; near these the topology need not be that
    of the true level set. ``reversed_polygons``: those that face against the true gradient afterwards, parts of these.
    ``divided_polygons``: how many were divided to come closer to the curved level set; ``wanted_mean_abs_f``: the mean
    |f| over the faces that this was to reach.
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
    wanted_mean_abs_f: float


def polish(
    surface: Surface,
    network: Network,
    lower: Floats,
    upper: Floats,
    *,
    threads: int | None = None,
    flatness: float = FLATNESS,
    most_polygons: float = np.inf,
) -> tuple[Surface, Polish]:
    """The surface with its vertices on the level set of the true functions of ``network``, and what was done.

    ``surface``: the level set of canonical ``network`` in the box ``lower``..``upper`` (float64 [3]). ``flatness``:
    faces are divided until their mean |f| is this part of the typical slope times half of the box (infinite: none
    is) or there are about ``most_polygons``. The polygons of the result need not be flat; their gradients are those of
    the true network a short step from the corners, or interpolated where faces were divided; ``errors`` and attributes
    are those of the polygons they come from. Raises ValueError for a surface without polygons.
    """
    if not surface.n_polygons:
        raise ValueError("a surface without polygons has no vertices to move")
    threads = resolve_threads(threads)
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    projection = Projection.of(surface, TrueField(network, threads), lower, upper)
    before = np.abs(projection.values)
    everywhere = np.arange(surface.n_polygons)
    upright = facing(surface.vertices, projection.gradients, surface.offsets, surface.corners, everywhere) > 0
    projection.project(np.arange(surface.n_vertices))
    slid, _ = turn_back(surface, projection, upright, everywhere, threads)
    moves = projection.positions - surface.vertices
    largest_move = float(np.sqrt((moves**2).sum(axis=1)).max())
    del moves
    moved = replace(surface, vertices=projection.positions.copy())
    wanted = flatness * projection.slope * 0.5 * float((upper - lower).max())
    result, divided = divide(moved, projection, wanted, most_polygons, threads)
    result, reversed_polygons = _with_gradients(result, projection)
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
        held_vertices=int(np.count_nonzero(projection.held)),
        stray_vertices=int(np.count_nonzero(~projection.settled() & ~projection.held)),
        turned_polygons=int(np.count_nonzero(~upright)),
        turned_area_share=float(areas[~upright].sum() / max(areas.sum(), np.finfo(np.float64).tiny)),
        reversed_polygons=reversed_polygons,
        divided_polygons=divided,
        wanted_mean_abs_f=wanted,
    )


def _with_gradients(surface: Surface, projection: Projection) -> tuple[Surface, int]:
    """The surface with the true gradients of its polygons, and the number of those that face against theirs."""
    everywhere = np.arange(surface.n_polygons)
    gradients = mean_over_corners(projection.gradients, surface.offsets, surface.corners, everywhere)
    against = facing(surface.vertices, projection.gradients, surface.offsets, surface.corners, everywhere) < 0
    gradients[against] *= -1
    return replace(surface, gradients=gradients), int(np.count_nonzero(against))
