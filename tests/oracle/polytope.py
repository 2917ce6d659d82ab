"""Convex polytopes of any dimension in exact rational arithmetic, by the double description method.

A polytope keeps its halfspaces and its vertices; every vertex knows which halfspaces are tight there, so that adjacency
is decided combinatorially and stays right where more than ``d`` planes meet (Fukuda & Prodon, Double description method
revisited, 1996, proposition 7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cmp_to_key
from itertools import pairwise

Point = tuple[Fraction, ...]


@dataclass(frozen=True)
class Affine:
    """The affine function ``normal . x + offset``."""

    normal: Point
    offset: Fraction

    def __call__(self, point: Point) -> Fraction:
        return sum((a * x for a, x in zip(self.normal, point, strict=True)), self.offset)

    def scaled(self, factor: Fraction, shift: Fraction = Fraction(0)) -> Affine:
        """``factor * self + shift``."""
        return Affine(tuple(factor * a for a in self.normal), factor * self.offset + shift)

    @property
    def is_constant(self) -> bool:
        return not any(self.normal)


def combine(terms: Sequence[tuple[Fraction, Affine]], bias: Fraction, dimension: int) -> Affine:
    """``bias + sum factor * affine`` over ``terms``."""
    normal = tuple(sum((f * affine.normal[axis] for f, affine in terms), Fraction(0)) for axis in range(dimension))
    return Affine(normal, sum((f * affine.offset for f, affine in terms), bias))


@dataclass(frozen=True)
class Vertex:
    """``tight`` is the bit set of the halfspaces whose boundary goes through ``position``."""

    position: Point
    tight: int


@dataclass(frozen=True)
class Polytope:
    """A bounded polytope with interior: the points where every function of ``halfspaces`` is at least zero."""

    halfspaces: tuple[Affine, ...]
    vertices: tuple[Vertex, ...]

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float]) -> Polytope:
        """The box; halfspace ``2 * axis + side`` bounds ``axis`` from below (side 0) or above (side 1)."""
        dimension = len(lower)
        bounds = [(Fraction(low), Fraction(high)) for low, high in zip(lower, upper, strict=True)]
        halfspaces = []
        for axis, (low, high) in enumerate(bounds):
            unit = tuple(Fraction(int(axis == other)) for other in range(dimension))
            halfspaces += [Affine(unit, -low), Affine(tuple(-a for a in unit), high)]
        vertices = []
        for corner in range(2**dimension):
            sides = [corner >> axis & 1 for axis in range(dimension)]
            position = tuple(bounds[axis][side] for axis, side in enumerate(sides))
            vertices.append(Vertex(position, sum(1 << (2 * axis + side) for axis, side in enumerate(sides))))
        return cls(tuple(halfspaces), tuple(vertices))

    @property
    def dimension(self) -> int:
        return len(self.halfspaces[0].normal)

    def section(self, plane: Affine) -> tuple[Vertex, ...]:
        """The vertices of the polytope's intersection with ``plane = 0``, tight there too (bit ``len(halfspaces)``)."""
        bit = 1 << len(self.halfspaces)
        values = [plane(vertex.position) for vertex in self.vertices]
        cut = [Vertex(v.position, v.tight | bit) for v, value in zip(self.vertices, values, strict=True) if not value]
        positive = [(v, value) for v, value in zip(self.vertices, values, strict=True) if value > 0]
        negative = [(v, value) for v, value in zip(self.vertices, values, strict=True) if value < 0]
        for high, above in positive:
            for low, below in negative:
                common = high.tight & low.tight
                if self._is_edge(high, low, common):
                    ratio = above / (above - below)
                    position = tuple(h + ratio * (w - h) for h, w in zip(high.position, low.position, strict=True))
                    cut.append(Vertex(position, common | bit))
        return tuple(cut)

    def _is_edge(self, first: Vertex, second: Vertex, common: int) -> bool:
        if common.bit_count() < self.dimension - 1:
            return False
        return not any(v.tight & common == common and v is not first and v is not second for v in self.vertices)

    def split(self, plane: Affine) -> tuple[Polytope | None, Polytope | None]:
        """The parts where ``plane`` is at most and at least zero; None where a part has no interior."""
        values = [plane(vertex.position) for vertex in self.vertices]
        if min(values) >= 0:
            return None, self
        if max(values) <= 0:
            return self, None
        cut = self.section(plane)
        below = tuple(v for v, value in zip(self.vertices, values, strict=True) if value < 0)
        above = tuple(v for v, value in zip(self.vertices, values, strict=True) if value > 0)
        return (
            Polytope((*self.halfspaces, plane.scaled(Fraction(-1))), below + cut),
            Polytope((*self.halfspaces, plane), above + cut),
        )

    def volume(self) -> Fraction:
        """The volume of a polytope in three dimensions, as the sum of the cones over its facets."""
        total = Fraction(0)
        for index, halfspace in enumerate(self.halfspaces):
            facet = [vertex.position for vertex in self.vertices if vertex.tight >> index & 1]
            if len(facet) >= 3:
                outward = tuple(-a for a in halfspace.normal)
                total += dot(facet[0], area_vector(ordered_polygon(facet, outward)))
        return total / 3


def dot(first: Point, second: Point) -> Fraction:
    return sum((a * b for a, b in zip(first, second, strict=True)), Fraction(0))


def cross(first: Point, second: Point) -> Point:
    """The vector product in three dimensions."""
    (a, b, c), (d, e, f) = first, second
    return b * f - c * e, c * d - a * f, a * e - b * d


def subtract(first: Point, second: Point) -> Point:
    return tuple(a - b for a, b in zip(first, second, strict=True))


def ordered_polygon(points: Sequence[Point], normal: Point) -> tuple[Point, ...]:
    """The corners of a planar convex polygon, counter-clockwise seen from the tip of ``normal``, smallest first."""
    start = min(points)
    others = [point for point in points if point != start]

    def turn(first: Point, second: Point) -> int:
        side = dot(cross(subtract(first, start), subtract(second, start)), normal)
        return (side < 0) - (side > 0)

    return (start, *sorted(others, key=cmp_to_key(turn)))


def area_vector(polygon: Sequence[Point]) -> Point:
    """The polygon's unit normal times its area."""
    start = polygon[0]
    total: Point = (Fraction(0),) * 3
    for first, second in pairwise(polygon[1:]):
        part = cross(subtract(first, start), subtract(second, start))
        total = tuple(a + b / 2 for a, b in zip(total, part, strict=True))
    return total
