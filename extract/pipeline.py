"""From a canonical network to its level set as a checked mesh: traversal, welding and the cure of degenerate cases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.clock import PhaseClock
from mn_onnx.extract.degeneracy.box_copies import drop_box_copies
from mn_onnx.extract.degeneracy.contract import contract_short_edges
from mn_onnx.extract.degeneracy.flat import FlatRegions, find_flat_regions
from mn_onnx.extract.degeneracy.limit import SCALES, limit_surface
from mn_onnx.extract.degeneracy.perturb import perturbation
from mn_onnx.extract.measures import lengths
from mn_onnx.extract.schedule import Progress, TraversalStatistics, traverse
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]

PERTURBATION_SIZES = (1e-9, 1e-10, 1e-11, 1e-12, 1e-8)
"""Tried in this order: above the rounding of the traversal (about 1e-13), below the features of a network."""

COINCIDENCE = 1e-12
"""Vertices closer than this, relative to the box, may be one point: above rounding, below a perturbation's size."""

ROUNDINGS = 16 * float(np.finfo(np.float64).eps)
"""By how much rounding may shift a plane, relative to the magnitudes that a perturbation's size is relative to."""

SHALLOW = 1e-12
"""A gradient this small, relative to the largest one, may be zero but for rounding."""


@dataclass(frozen=True)
class Degeneracy:
    """What was degenerate about a network in its box, and what was done about it.

    ``found``: sentences that say why the exact traversal could not be trusted; empty where it could.
    ``perturbation``: the relative size of the shifts under which the mesh was found, None if none was needed, or none
    gave a better mesh; the vertices have been taken back to the network as it is. ``displacement``: the farthest any
    vertex was taken back. ``merged_vertices``, ``removed_polygons``: what coincided or had no area. ``box_copies``:
    polygons in a box face, which are left out unless ``only_box_copies``: there are no others. ``attempts``:
    perturbations tried.
    """

    found: tuple[str, ...] = ()
    perturbation: float | None = None
    displacement: float = 0.0
    merged_vertices: int = 0
    removed_polygons: int = 0
    box_copies: int = 0
    only_box_copies: bool = False
    attempts: int = 0


@dataclass(frozen=True, eq=False)
class Extraction:
    """The level set of a network, and how it was found.

    ``statistics`` are those of the first traversal; ``seconds`` the time of each phase by name: traverse, weld, flat,
    and perturb if that was needed. ``coincidence``: vertices closer than this may be one point.
    """

    surface: Surface
    statistics: TraversalStatistics
    degeneracy: Degeneracy
    flat_regions: FlatRegions
    seconds: dict[str, float]
    coincidence: float

    @property
    def position_error(self) -> float | None:
        """How far a coordinate may be from the true one because vertices were taken back; None if they were not.

        What moves vertices much further than the perturbation moves planes does the same with rounding errors.
        """
        size = self.degeneracy.perturbation
        return None if size is None else self.coincidence + ROUNDINGS / size * self.degeneracy.displacement


@dataclass(frozen=True, eq=False)
class _Run:
    """One call's arguments and clock."""

    lower: Floats
    upper: Floats
    threads: int | None
    progress: Callable[[Progress], None] | None
    clock: PhaseClock

    @property
    def coincidence(self) -> float:
        return COINCIDENCE * float(max(np.abs([self.lower, self.upper]).max(), (self.upper - self.lower).max()))


class RunOptions(TypedDict, total=False):
    """How an extraction runs; nothing here changes its result.

    ``threads``: worker threads, all cores by default. ``progress``: called a few times a second during traversals; what
    it raises stops the extraction. ``on_phase``: called with the name of each phase as it begins.
    """

    threads: int | None
    progress: Callable[[Progress], None] | None
    on_phase: Callable[[str], None]


def extract_surface(network: Network, lower: Floats, upper: Floats, **options: Unpack[RunOptions]) -> Extraction:
    """The level set f = 0 of a canonical network in the open box ``lower``..``upper`` (float64 [3] each).

    The surface is the boundary of {f < 0}: a polygon that lies in a face of the box is no part of it (unless there are
    no others: a solid that fills the box), and of a region where f is zero throughout only the border with f < 0 is.
    Where {f < 0} touches itself in a point or an edge, the mesh has vertices for each of the parts that touch.

    A network in general position is traversed once, as it is. Where planes coincide or meet by design, the mesh is that
    of a perturbed network in the limit of no perturbation (see `mn_onnx.extract.degeneracy.limit`). If no perturbation
    gives a closed mesh the best one found is returned: ``surface.unmatched`` and the degeneracy tell, and the caller
    must.

    ``options``: see `RunOptions`. Raises ``ValueError`` for a network that is not canonical or an empty box.
    """
    run = _Run(
        np.asarray(lower, np.float64),
        np.asarray(upper, np.float64),
        options.get("threads"),
        options.get("progress"),
        PhaseClock(options.get("on_phase", lambda _: None)),
    )
    clock = run.clock
    with clock.phase("traverse"):
        soup, statistics = traverse(network, run.lower, run.upper, threads=run.threads, progress=run.progress)
    with clock.phase("weld"):
        surface, degeneracy = _as_it_is(soup, statistics.broken_cuts, run)
        del soup
    flat_regions = FlatRegions()
    if not degeneracy.found:
        with clock.phase("flat"):
            flat_regions = find_flat_regions(network, run.lower, run.upper, surface, threads=run.threads)
        if flat_regions:
            # A surface that borders on zeros lies in a plane where pieces of f meet: rounding may lose all of it.
            degeneracy = replace(degeneracy, found=("f is zero throughout a part of the box",))
    if degeneracy.found:
        with clock.phase("perturb"):
            surface, degeneracy = _in_the_limit(network, run, surface, degeneracy)
        with clock.phase("flat"):
            flat_regions = find_flat_regions(network, run.lower, run.upper, surface, threads=run.threads)
    return Extraction(surface, statistics, degeneracy, flat_regions, clock.seconds, run.coincidence)


def _as_it_is(soup: PolygonSoup, broken_cuts: int, run: _Run) -> tuple[Surface, Degeneracy]:
    """The surface of an unperturbed ``soup``; ``found`` tells what in it only rounding can have caused."""
    soup, n_dropped = _whole_polygons(soup)
    surface = weld(soup, threads=run.threads)
    counts = ((broken_cuts, "cells too degenerate to be cut"), (n_dropped, "polygons with fewer than 3 corners"))
    found = (*(f"{count} {what}" for count, what in counts if count), *_torn(surface))
    if found:
        return surface, Degeneracy(found)
    surface, degeneracy = _cleaned(surface, run, 0.0, Degeneracy())
    return surface, replace(degeneracy, found=(*_torn(surface), *_doubtful(surface, run.coincidence)))


def _in_the_limit(network: Network, run: _Run, torn: Surface, degeneracy: Degeneracy) -> tuple[Surface, Degeneracy]:
    """The surface under the first perturbation that closes it and has its limit on the level set.

    If there is none: the closed one nearest to the level set, or else that with the fewest unmatched edges.
    """
    best = torn, degeneracy
    # A torn mesh is better than one that a perturbation tears as much; any closed one is better than a doubtful one.
    best_rank = bool(_torn(torn)), torn.unmatched.size, 0.0 if _torn(torn) else np.inf
    for attempt, size in enumerate(PERTURBATION_SIZES):
        candidate = _perturbed(network, run, size, attempt)
        if candidate is None:
            continue
        surface, displacement = candidate
        tried = Degeneracy(degeneracy.found, size, displacement, attempts=attempt + 1)
        surface, tried = _cleaned(surface, run, run.coincidence, tried)
        distance = _distance(network, run, surface)
        is_torn = bool(_torn(surface))
        if not is_torn and distance <= run.coincidence:
            return surface, tried
        rank = is_torn, surface.unmatched.size, distance
        if rank < best_rank:
            best, best_rank = (surface, tried), rank
    return best[0], replace(best[1], attempts=len(PERTURBATION_SIZES))


def _distance(network: Network, run: _Run, surface: Surface) -> float:
    """How far the vertices are from the level set in the box at most: by |f| and the steepest slope, and outside it.

    Far above rounding where a perturbation exceeded a feature, so that no plane changes sides between its two scales
    but one does on the way to none.
    """
    if not surface.n_polygons:
        return 0.0
    vertices = surface.vertices
    steepest = max(lengths(surface.gradients).max(), np.finfo(np.float64).tiny)
    from_level = np.abs(evaluate(network, vertices)).max() / steepest
    return float(max(from_level, (run.lower - vertices).max(), (vertices - run.upper).max()))


def _whole_polygons(soup: PolygonSoup) -> tuple[PolygonSoup, int]:
    """The soup without polygons of fewer than three corners, and how many those were."""
    sizes = np.diff(soup.offsets)
    whole = sizes >= 3
    if whole.all():
        return soup, 0
    corners = np.repeat(whole, sizes)
    points, first_corners, numbers = np.unique(soup.corners[corners], return_index=True, return_inverse=True)
    order = np.argsort(first_corners)
    kept = PolygonSoup(
        np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes[whole])]),
        np.argsort(order)[numbers].astype(soup.corners.dtype),
        soup.positions[points[order]],
        soup.keys[points[order]],
        soup.box_faces[corners],
        soup.gradients[whole],
        soup.errors[whole],
    )
    return kept, int(np.count_nonzero(~whole))


def _torn(surface: Surface) -> tuple[str, ...]:
    """What tells that signs were decided differently in different cells, a sentence each."""
    counts = (
        (surface.unmatched.size, "edges inside the box without neighbour"),
        (int(surface.report["position_disagreements"]), "vertices with corners that lie apart"),
    )
    return tuple(f"{count} {what}" for count, what in counts if count)


def _narrow(surface: Surface, length: float) -> int:
    """The number of polygons that have an edge of at most ``length`` or are no wider than that."""
    measures = surface.measures
    return int(np.count_nonzero((measures.shortest_edges <= length) | (measures.areas <= length * measures.perimeters)))


def _doubtful(surface: Surface, length: float) -> tuple[str, ...]:
    """What may be due to rounding in a surface that is closed, a sentence each."""
    slopes = lengths(surface.gradients)
    shallow = int(np.count_nonzero(slopes <= SHALLOW * slopes.max(initial=0.0)))
    counts = (
        (_narrow(surface, length), "polygons that may have no width but for rounding"),
        (shallow, "polygons on which f may have no slope but for rounding"),
    )
    return tuple(f"{count} {what}" for count, what in counts if count)


def _cleaned(surface: Surface, run: _Run, length: float, degeneracy: Degeneracy) -> tuple[Surface, Degeneracy]:
    """The surface without edges of at most ``length``, polygons without area and copies of box faces."""
    if _narrow(surface, length):
        surface, contraction = contract_short_edges(surface, length)
        degeneracy = replace(
            degeneracy,
            merged_vertices=contraction.merged_vertices,
            removed_polygons=contraction.removed_polygons,
        )
    inner, box_copies = drop_box_copies(surface, run.lower, run.upper, run.coincidence)
    # A solid that fills the box has nothing but copies of its faces, and is better shown than called empty.
    if box_copies and not inner.n_polygons:
        return surface, replace(degeneracy, box_copies=box_copies, only_box_copies=True)
    return inner, replace(degeneracy, box_copies=box_copies)


def _perturbed(network: Network, run: _Run, size: float, seed: int) -> tuple[Surface, float] | None:
    """The mesh in the limit of a perturbation, and the largest displacement; None if it cannot be had with ``size``.

    Because it is not small enough, or because cells under it are too degenerate to be cut.
    """
    shifts = perturbation(network, run.lower, run.upper, size=size, seed=seed)
    soups, surfaces = [], []
    for scale in SCALES:
        soup, statistics = traverse(shifts.at(scale), run.lower, run.upper, threads=run.threads, progress=run.progress)
        if statistics.broken_cuts:
            return None
        soup, _ = _whole_polygons(soup)
        soups.append(soup)
        surfaces.append(weld(soup, threads=run.threads))
    return limit_surface((soups[0], soups[1]), (surfaces[0], surfaces[1]))
