"""Level sets in the plane, as polylines, and on the line, as roots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Curve:
    """``s`` directed segments on ``v`` vertices, chained to ``k`` polylines; f is smaller on the left of a segment.

    A closed polyline around a region where f is negative runs counter-clockwise.

    ``vertices``: float64 [v, 2]. ``segments``: int64 [s, 2], the vertices that each leaves and reaches, in order along
    the polylines. ``offsets``: int64 [k + 1]; polyline ``i`` is the segments ``offsets[i]:offsets[i + 1]``.
    ``closed``: bool [k]. ``gradients``: float64 [s, 2], the gradient of ``f`` on each segment. ``errors``: float64 [s],
    a proved bound on ``|f_true - f|`` there. ``lower``, ``upper``: float64 [2], the box.
    """

    vertices: Floats
    segments: Integers
    offsets: Integers
    closed: NDArray[np.bool_]
    gradients: Floats
    errors: Floats
    lower: Floats
    upper: Floats

    @classmethod
    def from_segments(
        cls, vertices: Floats, segments: Integers, gradients: Floats, errors: Floats, lower: Floats, upper: Floats
    ) -> Curve:
        """Chain directed segments in any order; arguments as the attributes.

        Open polylines come first, then closed ones, each kind in the order of their first segments.
        """
        order, offsets, closed = _chains(segments, len(vertices))
        return cls(vertices, segments[order], offsets, closed, gradients[order], errors[order], lower, upper)

    @property
    def n_segments(self) -> int:
        return len(self.segments)

    @property
    def n_polylines(self) -> int:
        return self.closed.size

    @cached_property
    def lengths(self) -> Floats:
        """float64 [s], the length of each segment."""
        steps = self.vertices[self.segments[:, 1]] - self.vertices[self.segments[:, 0]]
        return np.asarray(np.sqrt((steps**2).sum(axis=1)))

    @property
    def length(self) -> float:
        return float(self.lengths.sum())

    @property
    def area(self) -> float | None:
        """The area in which ``f`` is negative, less that of holes; None if a polyline is open."""
        if not self.closed.all():
            return None
        tails, heads = self.vertices[self.segments[:, 0]], self.vertices[self.segments[:, 1]]
        return float(0.5 * (tails[:, 0] * heads[:, 1] - tails[:, 1] * heads[:, 0]).sum())

    def polyline(self, index: int) -> Floats:
        """The vertices of polyline ``index`` in order, float64 [n, 2]; the first is not repeated at the end."""
        segments = self.segments[self.offsets[index] : self.offsets[index + 1]]
        ends = segments[:, 0] if self.closed[index] else np.append(segments[:, 0], segments[-1, 1])
        return self.vertices[ends]

    def problems(self, *, distance: float = 1e-9) -> list[str]:
        """What a correct extraction never shows, a sentence each; empty if all is well.

        ``distance``: how far from the box, relative to its size, the end of an open polyline may be.
        """
        leaving = np.bincount(self.segments[:, 0], minlength=len(self.vertices))
        reaching = np.bincount(self.segments[:, 1], minlength=len(self.vertices))
        gaps = np.minimum(np.abs(self.vertices - self.lower), np.abs(self.vertices - self.upper)).min(
            axis=1, initial=np.inf
        )
        inside = gaps > distance * (self.upper - self.lower).max()
        left = np.stack([-self.gradients[:, 1], self.gradients[:, 0]], axis=1)
        steps = self.vertices[self.segments[:, 1]] - self.vertices[self.segments[:, 0]]
        counts = (
            (int(np.count_nonzero((leaving != reaching) & inside)), "ends of polylines are inside the box"),
            (int(np.count_nonzero((leaving > 1) | (reaching > 1))), "vertices have more than two segments"),
            (int(np.count_nonzero(self.lengths == 0)), "segments have no length"),
            (int(np.count_nonzero((left * steps).sum(axis=1) < 0)), "segments run against their gradient"),
        )
        return [f"{count} {what}" for count, what in counts if count]


def _chains(segments: Integers, n_vertices: int) -> tuple[Integers, Integers, NDArray[np.bool_]]:
    """Segments in order along polylines, the first of each polyline, and which are closed."""
    leaving = np.full(n_vertices, -1)
    leaving[segments[:, 0]] = np.arange(len(segments))
    reached = np.zeros(n_vertices, np.bool_)
    reached[segments[:, 1]] = True
    following = leaving[segments[:, 1]].tolist()
    starts = np.flatnonzero(~reached[segments[:, 0]]).tolist()
    seen = [False] * len(segments)
    order: list[int] = []
    offsets, closed = [0], []
    for start in [*starts, *range(len(segments))]:
        segment = start
        while segment >= 0 and not seen[segment]:
            seen[segment] = True
            order.append(segment)
            segment = following[segment]
        if len(order) > offsets[-1]:
            offsets.append(len(order))
            closed.append(segment == start)
    return np.array(order, np.int64), np.array(offsets, np.int64), np.array(closed, np.bool_)


@dataclass(frozen=True, eq=False)
class Roots:
    """Where a function of one variable changes its sign between negative and not negative.

    ``positions``: float64 [r], ascending; ``slopes``: float64 [r], the slope of ``f`` on the piece where it is negative
    next to the root; positive where f grows from negative to positive. ``errors``: float64 [r], a proved bound on
    ``|f_true - f|`` there. ``lower``, ``upper``: the interval.
    """

    positions: Floats
    slopes: Floats
    errors: Floats
    lower: float
    upper: float

    def problems(self) -> list[str]:
        """What a correct extraction never shows, a sentence each: neighbouring roots have slopes of opposite sign."""
        signs = np.sign(self.slopes)
        repeated = int(np.count_nonzero(signs[1:] == signs[:-1]) + np.count_nonzero(signs == 0))
        return [f"{repeated} roots have the same direction as their neighbour, or none"] if repeated else []
