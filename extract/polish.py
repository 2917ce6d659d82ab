"""Moves the vertices of a surface onto the level set of the true network, and keeps its topology.

Every vertex moves along one line: the mean gradient of the faces around it, which turns less from vertex to vertex than
the gradient at each of them, so that neighbours stay in order. On that line the root of ``f_true`` is found by secant
steps, Newton's with the slope measured rather than derived (Dahlquist and Bjorck, Numerical Methods, section 6.4).
Vertices on the box stay on the faces of the box that hold them. Where a face would turn over, its vertices go back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import resolve_threads, run_blocks
from mn_onnx.extract.measures import measure_polygons
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

STEPS = 8
CONVERGED = 1e-12
"""|f| relative to the slope times the box: nothing is gained beyond."""

REACH = 2.0
"""A vertex moves at most this many times the displacement that the error bounds of its faces allow."""

NEWTON_REACH = 3.0
"""Nor farther than this many Newton steps: beyond, the mean slope tells nothing of where the level set is."""

RETREATS = 12
"""Vertices of faces that would turn over go half the way back this often, then all the way."""

BLOCK = 1 << 14


@dataclass(frozen=True)
class Polish:
    """What polishing did. ``f`` is the canonical value of the true network, zero on its level set.

    ``max_abs_f_before``, ``mean_abs_f_before``, ``max_abs_f``, ``mean_abs_f``: |f| over the vertices, before and after.
    ``largest_move``: the farthest a vertex went. ``held_vertices``: those left short of the level set so that no face
    turns over. ``stray_vertices``: those that found no root within their reach.
    """

    max_abs_f_before: float
    mean_abs_f_before: float
    max_abs_f: float
    mean_abs_f: float
    largest_move: float
    held_vertices: int
    stray_vertices: int


def polish(
    surface: Surface, network: Network, lower: Floats, upper: Floats, *, threads: int | None = None
) -> tuple[Surface, Polish]:
    """The surface with its vertices on the level set of the true functions of ``network``, and what was done.

    ``surface``: the level set of canonical ``network`` in the box ``lower``..``upper`` (float64 [3]), with ``errors``
    set. Connectivity and order stay. The gradients of the result are normal to its polygons, as long as before; its
    ``errors`` are still those of the surface before.
    """
    threads = resolve_threads(threads)
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)

    def f(points: Floats) -> Floats:
        return _parallel(lambda part: evaluate(network, part, true_functions=True), points, threads)

    directions, slopes = _directions(surface)
    reach = REACH * _largest_around(surface, _displacements(surface))
    before = f(surface.vertices)
    reach = np.minimum(reach, NEWTON_REACH * np.abs(before) / np.where(slopes > 0, slopes, 1.0))
    lengths, after = _roots(f, surface.vertices, directions, before, slopes, reach, lower, upper)
    found = np.abs(after) < np.abs(before)
    moved = np.where(found[:, None], np.clip(surface.vertices + lengths[:, None] * directions, lower, upper),
                     surface.vertices)  # fmt: skip
    settled = np.abs(after) <= 1e-9 * slopes * float((upper - lower).max())
    shares = _shares_without_flips(surface, moved, threads)
    held = shares < 1.0
    vertices = np.where(held[:, None], surface.vertices + shares[:, None] * (moved - surface.vertices), moved)
    after = np.where(found, after, before)
    after[held] = f(vertices[held])
    result = Polish(
        max_abs_f_before=float(np.abs(before).max()),
        mean_abs_f_before=float(np.abs(before).mean()),
        max_abs_f=float(np.abs(after).max()),
        mean_abs_f=float(np.abs(after).mean()),
        largest_move=float(np.sqrt(((vertices - surface.vertices) ** 2).sum(axis=1)).max()),
        held_vertices=int(np.count_nonzero(held)),
        stray_vertices=int(np.count_nonzero(~settled & ~held)),
    )
    measures = measure_polygons(vertices, surface.offsets, surface.corners, threads)
    lengths_of = np.sqrt((measures.area_vectors**2).sum(axis=1))
    steepness = np.sqrt((surface.gradients**2).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        gradients = np.where(
            lengths_of[:, None] > 0,
            measures.area_vectors * (steepness / lengths_of)[:, None],
            surface.gradients,
        )
    return replace(surface, vertices=vertices, gradients=gradients), result


def _parallel(work: Callable[[Floats], Floats], points: Floats, threads: int) -> Floats:
    result = np.empty(len(points))

    def run(first: int, last: int) -> None:
        for block in range(first, last):
            part = slice(block * BLOCK, (block + 1) * BLOCK)
            result[part] = work(points[part])

    run_blocks(run, -(-len(points) // BLOCK), threads)
    return result


def _displacements(surface: Surface) -> Floats:
    """How far the level set may be from each polygon, to first order: error over slope, [p]."""
    steepness = np.sqrt((surface.gradients**2).sum(axis=1))
    return np.where(steepness > 0, surface.errors / np.where(steepness > 0, steepness, 1.0), 0.0)


def _largest_around(surface: Surface, of_polygons: Floats) -> Floats:
    largest = np.zeros(surface.n_vertices)
    np.maximum.at(largest, surface.corners, np.repeat(of_polygons, surface.polygon_sizes))
    return largest


def _directions(surface: Surface) -> tuple[Floats, Floats]:
    """The unit vectors [v, 3] that vertices move along, and the slope [v] of ``f`` along them.

    The mean gradient around each vertex, without the components that would leave a face of the box.
    """
    totals = np.zeros((surface.n_vertices, 3))
    of_corners = np.repeat(surface.gradients, surface.polygon_sizes, axis=0)
    for axis in range(3):
        totals[:, axis] = np.bincount(surface.corners, of_corners[:, axis], surface.n_vertices)
    counts = np.bincount(surface.corners, minlength=surface.n_vertices)
    means = totals / np.maximum(counts, 1)[:, None]
    on_box = np.flatnonzero(surface.box_faces >= 0)
    following = _next_corners(surface)
    for vertices in (surface.corners[on_box], surface.corners[following[on_box]]):
        means[vertices, surface.box_faces[on_box] // 2] = 0.0
    slopes = np.sqrt((means**2).sum(axis=1))
    return means / np.where(slopes > 0, slopes, 1.0)[:, None], slopes


def _next_corners(surface: Surface) -> NDArray[np.int64]:
    following = np.arange(1, surface.n_corners + 1)
    following[surface.offsets[1:] - 1] = surface.offsets[:-1]
    return following


def _roots(
    f: Callable[[Floats], Floats],
    start: Floats,
    directions: Floats,
    at_start: Floats,
    slopes: Floats,
    reach: Floats,
    lower: Floats,
    upper: Floats,
) -> tuple[Floats, Floats]:
    """Lengths [v] along ``directions`` at which |f| is least of all that were tried, and f there [v].

    A length is at most ``reach``, and leads to a point of the box.
    """
    best, at_best = np.zeros(len(start)), at_start.copy()
    previous, at_previous = best.copy(), at_start.copy()
    slope = slopes.copy()
    scale = CONVERGED * slopes * float((upper - lower).max())
    active = np.flatnonzero((np.abs(at_start) > scale) & (slopes > 0) & (reach > 0))
    for _ in range(STEPS):
        if not active.size:
            break
        step = np.clip(best[active] - at_best[active] / slope[active], -reach[active], reach[active])
        value = f(np.clip(start[active] + step[:, None] * directions[active], lower, upper))
        change = step - previous[active]
        with np.errstate(invalid="ignore", divide="ignore"):
            measured = (value - at_previous[active]) / change
        # A slope far below the mean one would throw the vertex far away.
        usable = np.isfinite(measured) & (measured > 0.1 * slopes[active])
        slope[active] = np.where(usable, measured, np.maximum(slope[active], slopes[active]) * 2)
        better = np.abs(value) < np.abs(at_best[active])
        previous[active] = np.where(better, best[active], step)
        at_previous[active] = np.where(better, at_best[active], value)
        best[active[better]], at_best[active[better]] = step[better], value[better]
        # After a step that fails the secant through both points, the best one and the failed one, is tried next.
        active = active[(np.abs(at_best[active]) > scale[active]) & (better | (np.abs(change) > 0))]
    return best, at_best


def _shares_without_flips(surface: Surface, moved: Floats, threads: int) -> Floats:
    """Which share of its way to ``moved`` each vertex goes, [v], so that no polygon turns over."""
    before = measure_polygons(surface.vertices, surface.offsets, surface.corners, threads).area_vectors
    shares = np.ones(surface.n_vertices)
    sizes = surface.polygon_sizes
    retreat = 0
    while True:
        vertices = surface.vertices + shares[:, None] * (moved - surface.vertices)
        after = measure_polygons(vertices, surface.offsets, surface.corners, threads).area_vectors
        agreement = np.einsum("ij,ij->i", before, after)
        flipped = (agreement < 0) & (np.einsum("ij,ij->i", before, before) > 0)
        corners = surface.corners[np.repeat(flipped, sizes)]
        corners = corners[shares[corners] > 0]
        if not corners.size:
            return shares
        shares[np.unique(corners)] *= 0.5 if retreat < RETREATS else 0.0
        retreat += 1
