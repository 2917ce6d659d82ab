"""The exact level set ``f = 0`` of a tiny network: one facet per activation region that it cuts, and their topology.

A facet belongs to the boundary of ``{f < 0}`` in the open box: where ``f`` vanishes on a whole facet of a region, the
region counts only if ``f`` is negative inside. The facets therefore always close up, away from the box faces, in
degenerate cases too.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, reduce
from math import sqrt
from operator import and_

from mn_onnx.ir.network import Network
from oracle.polytope import Affine, Point, area_vector, dot, ordered_polygon, subtract
from oracle.regions import activation_regions


@dataclass(frozen=True)
class Facet:
    """The part of the level set in one region.

    ``vertices`` are in three dimensions a polygon's corners, counter-clockwise seen from where ``f`` is larger; in two
    dimensions a segment with the larger ``f`` on its left; in one dimension a single root.
    """

    states: tuple[int, ...]
    vertices: tuple[Point, ...]
    gradient: Point

    @property
    def centroid(self) -> Point:
        """The mean of the corners."""
        return tuple(sum(axis, Fraction(0)) / len(self.vertices) for axis in zip(*self.vertices, strict=True))


@dataclass(frozen=True)
class LevelSet:
    """``facets`` in lexicographic order of their states; ``flat_regions`` are the states where ``f`` is zero.

    ``inner_volume`` is the volume of ``{f < 0}`` in the box, from the cells and not from the facets (zero outside three
    dimensions).
    """

    lower: Point
    upper: Point
    facets: tuple[Facet, ...]
    flat_regions: tuple[tuple[int, ...], ...]
    n_regions: int
    inner_volume: Fraction

    @cached_property
    def vertices(self) -> tuple[Point, ...]:
        """The distinct vertices, in lexicographic order."""
        return tuple(sorted({vertex for facet in self.facets for vertex in facet.vertices}))

    @cached_property
    def directed_edges(self) -> Counter[tuple[Point, ...]]:
        """How often every directed edge of a polygon occurs (three dimensions)."""
        return Counter(edge for facet in self.facets for edge in _sides(facet.vertices))

    @property
    def n_edges(self) -> int:
        """The number of distinct undirected edges."""
        return len({frozenset(edge) for edge in self.directed_edges})

    @property
    def euler(self) -> int:
        return len(self.vertices) - self.n_edges + len(self.facets)

    @cached_property
    def boundary_edges(self) -> tuple[tuple[Point, ...], ...]:
        """Directed edges that the opposite directions do not cancel."""
        edges = self.directed_edges
        return tuple(edge for edge, count in edges.items() if count > edges[edge[1], edge[0]])

    def box_faces(self, points: Iterable[Point]) -> list[int]:
        """The box faces (``2 * axis + side``) on which all ``points`` lie."""
        columns = list(zip(*points, strict=True))
        bounds = [bound for pair in zip(self.lower, self.upper, strict=True) for bound in pair]
        return [face for face, bound in enumerate(bounds) if all(x == bound for x in columns[face // 2])]

    @cached_property
    def valences(self) -> Counter[Point]:
        """How many facets meet at every vertex."""
        return Counter(vertex for facet in self.facets for vertex in facet.vertices)

    @cached_property
    def components(self) -> tuple[tuple[Facet, ...], ...]:
        """The facets grouped by shared edges (three dimensions) or shared vertices (fewer)."""
        is_surface = len(self.lower) == 3
        by_side: dict[frozenset[Point], list[int]] = defaultdict(list)
        for index, facet in enumerate(self.facets):
            sides = _sides(facet.vertices) if is_surface else ((vertex,) for vertex in facet.vertices)
            for side in sides:
                by_side[frozenset(side)].append(index)
        neighbours: dict[int, set[int]] = defaultdict(set)
        for group in by_side.values():
            for index in group:
                neighbours[index].update(group)
        groups = []
        unseen = set(range(len(self.facets)))
        while unseen:
            reached, front = set(), {min(unseen)}
            while front:
                reached |= front
                front = set().union(*(neighbours[index] for index in front)) - reached
            unseen -= reached
            groups.append(tuple(self.facets[index] for index in sorted(reached)))
        return tuple(groups)

    @property
    def area(self) -> float:
        """The area of the polygons."""
        return sum(sqrt(dot(vector, vector)) for vector in (area_vector(facet.vertices) for facet in self.facets))

    @property
    def enclosed_volume(self) -> Fraction:
        """The volume inside a closed surface, by the divergence theorem."""
        return sum((dot(f.vertices[0], area_vector(f.vertices)) for f in self.facets), Fraction(0)) / 3

    @property
    def length(self) -> float:
        """The length of the segments (two dimensions)."""
        return sum(sqrt(dot(side, side)) for side in (subtract(f.vertices[1], f.vertices[0]) for f in self.facets))


def exact_level_set(network: Network, lower: Sequence[float], upper: Sequence[float]) -> LevelSet:
    """The level set of ``network`` in the box ``lower`` to ``upper``, by enumeration of all regions without pruning."""
    facets: list[Facet] = []
    flat_regions: list[tuple[int, ...]] = []
    box_planes = (1 << 2 * len(lower)) - 1
    n_regions = 0
    inner_volume = Fraction(0)
    for region in activation_regions(network, lower, upper):
        n_regions += 1
        if region.value.is_constant and not region.value.offset:
            flat_regions.append(region.states)
            continue
        inner = region.polytope.split(region.value)[0]
        if inner is None:
            continue
        if len(lower) == 3:
            inner_volume += inner.volume()
        cut = region.polytope.section(region.value)
        in_box_face = reduce(and_, (vertex.tight for vertex in cut), box_planes)
        if len(cut) >= len(lower) and not in_box_face:
            points = [vertex.position for vertex in cut]
            facets.append(Facet(region.states, _oriented(points, region.value), region.value.normal))
    return LevelSet(
        tuple(Fraction(low) for low in lower),
        tuple(Fraction(high) for high in upper),
        tuple(facets),
        tuple(flat_regions),
        n_regions,
        inner_volume,
    )


def _oriented(points: list[Point], value: Affine) -> tuple[Point, ...]:
    if len(value.normal) == 3:
        return ordered_polygon(points, value.normal)
    if len(value.normal) == 2:
        first, second = sorted(points)
        along = subtract(second, first)
        left = (-along[1], along[0])
        return (first, second) if dot(left, value.normal) > 0 else (second, first)
    return tuple(points)


def _sides(polygon: tuple[Point, ...]) -> Iterator[tuple[Point, ...]]:
    return zip(polygon, polygon[1:] + polygon[:1], strict=True)
