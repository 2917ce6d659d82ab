"""Moves the vertices of a mesh along the gradient onto the level set of the true network.

Far vertices follow the line of the gradient, x' = -f grad f / |grad f|^2, by Heun's method, in steps on which the
gradient hardly turns: neighbours arrive side by side, where straight lines would cross on the hollow side of a bend.
Near the level set Newton's method takes over. A step that does not lower |f| is shortened (Dennis and Schnabel,
Numerical Methods for Unconstrained Optimization and Nonlinear Equations, section 6.3). Vertices on faces of the box
stay on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import run_matrix_parts
from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

STEPS = 24
FLOW_STEPS = 200

CONVERGED = 1e-10
"""|f| relative to the slope times the box: nothing is gained beyond."""

SETTLED = 1e-8
"""The same: a vertex above found no root."""

NEAR = 1e-4
"""The same: below, Newton's method takes over, and the gradient is computed again only where it does badly."""

FAST = 0.1
"""A step that does well makes |f| smaller by at least this factor."""

STRAIGHT, MOST_TURN = np.cos(np.radians(0.5)), np.cos(np.radians(10.0))
"""Steps on which the gradient turns by less need no second stage of Heun's method; by more, they are shortened."""

AGREEMENT = 0.5
"""What a step along the gradient misses of the change of f that it was to make, at most."""

REACH = 4.0
"""A vertex moves at most this many times its first Newton step."""

SHALLOW = 0.1
"""Steps are measured with at least this part of the median slope: a gradient near zero tells nothing of distances."""

SHORTENING = 0.25
SHORTEST = 2.0**-12

BLOCK = 1 << 14


class TrueField:
    """The true functions of a network, with gradients, on ``threads`` threads."""

    def __init__(self, network: Network, threads: int) -> None:
        self._evaluator = Evaluator(network, true_functions=True)
        self._threads = threads

    def values(self, points: Floats) -> Floats:
        """``f`` at ``points`` [n, 3], float64 [n]."""
        result = np.empty(len(points))

        def work(part: slice) -> None:
            result[part] = self._evaluator.values(points[part])

        run_matrix_parts(work, len(points), BLOCK, self._threads)
        return result

    def values_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """``f`` and its gradient at ``points`` [n, 3], float64 [n] and [n, 3]; zero where there is no gradient."""
        values, gradients = np.empty(len(points)), np.empty((len(points), 3))

        def work(part: slice) -> None:
            values[part], gradients[part] = self._evaluator.values_and_gradients(points[part])

        run_matrix_parts(work, len(points), BLOCK, self._threads)
        gradients[~np.isfinite(gradients).all(axis=1)] = 0.0
        return values, gradients


@dataclass(eq=False)
class Projection:
    """Vertices on their way onto the level set. ``positions`` [v, 3], ``values`` [v]: where they are, and ``f`` there.

    ``gradients`` [v, 3]: of ``f``, a short step away, or means of those of neighbours. ``free`` bool [v, 3]: the axes
    along which a vertex may move. ``held`` bool [v]: those held back so that no face turns over. ``slope``: the typical
    one.
    """

    field: TrueField
    lower: Floats
    upper: Floats
    positions: Floats
    values: Floats
    gradients: Floats
    free: Booleans
    held: Booleans
    slope: float

    @classmethod
    def of(cls, surface: Surface, field: TrueField, lower: Floats, upper: Floats) -> Projection:
        """The vertices of ``surface`` where they are."""
        values, gradients = field.values_and_gradients(surface.vertices)
        lengths = _lengths(gradients)
        slope = float(np.median(lengths[lengths > 0])) if lengths.any() else 0.0
        held = np.zeros(len(values), bool)
        return cls(field, lower, upper, surface.vertices.copy(), values, gradients, free_axes(surface), held, slope)

    @property
    def scale(self) -> float:
        """|f| across the box, of a field of the typical slope."""
        return self.slope * float((self.upper - self.lower).max())

    def settled(self) -> Booleans:
        """Which vertices are on the level set, up to rounding and the last bits of a Newton iteration."""
        return np.asarray(np.abs(self.values) <= SETTLED * self.scale)

    def insert(self, order: Integers, positions: Floats, values: Floats, gradients: Floats, free: Booleans) -> None:
        """Number the vertices anew, and take in others.

        ``order``: int64 [n], vertex ``i`` was vertex ``order[i]``, or is new from the number of old ones on. Of the new
        ones by rising ``i``: ``positions`` [new, 3], ``values`` [new] where they are known already, else NaN,
        ``gradients`` [new, 3], which are good enough near the level set, and ``free`` [new, 3].
        """
        unknown = np.flatnonzero(np.isnan(values))
        values[unknown] = self.field.values(positions[unknown])
        far = np.flatnonzero(np.abs(values) > NEAR * self.scale)
        values[far], gradients[far] = self.field.values_and_gradients(positions[far])
        new = order >= len(self.values)
        of_old = order[~new]

        def merged(old: NDArray[Any], of_new: NDArray[Any]) -> NDArray[Any]:
            result = np.empty((order.size, *old.shape[1:]), old.dtype)
            result[~new], result[new] = old[of_old], of_new
            return result

        self.positions, self.values = merged(self.positions, positions), merged(self.values, values)
        self.gradients, self.free = merged(self.gradients, gradients), merged(self.free, free)
        self.held = merged(self.held, np.zeros(len(values), bool))

    def evaluate(self, vertices: Integers) -> None:
        """Bring values and gradients of ``vertices`` up to date."""
        self.values[vertices], self.gradients[vertices] = self.field.values_and_gradients(self.positions[vertices])

    def project(self, vertices: Integers) -> None:
        """Move ``vertices``, whose values and gradients are up to date, onto the level set, as far as they find it."""
        least = max(SHALLOW * self.slope, np.finfo(np.float64).tiny)
        steepness = np.maximum(_lengths(self.gradients[vertices] * self.free[vertices]), least)
        route = _Route(vertices, self.positions[vertices], REACH * np.abs(self.values[vertices]) / steepness)
        self._flow(route)
        self._settle(route)

    def _flow(self, route: _Route) -> None:
        """Follow the lines of the gradient until |f| is small."""
        share = np.ones(route.vertices.size)
        near = NEAR * self.scale
        at = np.flatnonzero(np.abs(self.values[route.vertices]) > near)
        for _ in range(FLOW_STEPS):
            if not at.size:
                break
            vertices = route.vertices[at]
            before, allowed = self.values[vertices], self._allowed(vertices)
            speed = _per_slope(self.gradients[vertices] * allowed)
            change = share[at] * before
            positions, values, gradients = self._try(route, at, change[:, None] * speed)
            turn = _cosines(self.gradients[vertices] * allowed, gradients * allowed)
            bent = np.flatnonzero((turn < STRAIGHT) & (turn >= MOST_TURN))
            if bent.size:
                mean_speed = 0.5 * (speed[bent] + _per_slope(gradients[bent] * allowed[bent]))
                positions[bent], values[bent], gradients[bent] = self._try(
                    route, at[bent], change[bent, None] * mean_speed
                )
            good = (turn >= MOST_TURN) & (np.abs(values - (before - change)) <= AGREEMENT * np.abs(change))
            moved = vertices[good]
            self.positions[moved], self.values[moved], self.gradients[moved] = (
                positions[good], values[good], gradients[good],
            )  # fmt: skip
            share[at] = np.where(good, np.minimum(1.0, 2.0 * share[at]), SHORTENING * share[at])
            at = at[(np.abs(self.values[vertices]) > near) & (share[at] >= SHORTEST)]

    def _try(self, route: _Route, at: Integers, moves: Floats) -> tuple[Floats, Floats, Floats]:
        """Positions after ``moves`` against the gradient, within reach and box, and values and gradients there."""
        positions = self._within(route, at, self.positions[route.vertices[at]] - moves)
        return positions, *self.field.values_and_gradients(positions)

    def _settle(self, route: _Route) -> None:
        """Newton's method, on the gradient of an earlier step and the secant along it where that does."""
        share = np.ones(route.vertices.size)
        stale = np.ones(route.vertices.size, bool)
        least = CONVERGED * self.scale
        at = np.flatnonzero(np.abs(self.values[route.vertices]) > least)
        for _ in range(STEPS):
            if not at.size:
                break
            vertices = route.vertices[at]
            before = self.values[vertices]
            speed = _per_slope(self.gradients[vertices] * self._allowed(vertices))
            positions = self._within(route, at, self.positions[vertices] - (share[at] * before)[:, None] * speed)
            values = self.field.values(positions)
            better = np.abs(values) < np.abs(before)
            moved = vertices[better]
            self.positions[moved], self.values[moved] = positions[better], values[better]
            # The secant: along the gradient, its length is what f has really changed by.
            ratio = (before - values)[better] / (share[at] * before)[better]
            self.gradients[moved] *= np.where(np.abs(ratio - 1.0) <= AGREEMENT, ratio, 1.0)[:, None]
            # A step along an old gradient that failed is taken again along the new one before it is shortened.
            share[at] = np.where(better, 1.0, np.where(stale[at], share[at], SHORTENING * share[at]))
            slow = np.abs(values) > FAST * np.abs(before)
            renewed = at[slow & (stale[at] | better)]
            stale[at] |= better
            self.evaluate(route.vertices[renewed])
            stale[renewed] = False
            at = at[(np.abs(self.values[vertices]) > least) & (share[at] >= SHORTEST)]

    def _allowed(self, vertices: Integers) -> Booleans:
        """The axes along which ``vertices`` may go, bool [n, 3]: one that meets a face of the box goes on along it."""
        positions, upward = self.positions[vertices], self.values[vertices, None] < 0
        rising = self.gradients[vertices] > 0
        out = np.where(rising == upward, positions >= self.upper, positions <= self.lower)
        return self.free[vertices] & ~out

    def _within(self, route: _Route, at: Integers, positions: Floats) -> Floats:
        """``positions``, but no farther from the start than may be, and in the box."""
        moves = positions - route.start[at]
        lengths = _lengths(moves)
        moves *= np.minimum(1.0, route.reach[at] / np.where(lengths > 0, lengths, 1.0))[:, None]
        return np.clip(route.start[at] + moves, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class _Route:
    """``vertices`` that are moved, where they ``start`` [n, 3], and how far each may go, ``reach`` [n]."""

    vertices: Integers
    start: Floats
    reach: Floats


def _per_slope(gradients: Floats) -> Floats:
    """The move that raises f by one along each gradient [n, 3], to first order; none where the gradient is zero."""
    squares = np.einsum("ij,ij->i", gradients, gradients)
    return np.asarray(gradients / np.where(squares > 0, squares, np.inf)[:, None])


def _cosines(a: Floats, b: Floats) -> Floats:
    """Of the angles between vectors [n, 3]."""
    lengths = _lengths(a) * _lengths(b)
    return np.asarray(np.einsum("ij,ij->i", a, b) / np.where(lengths > 0, lengths, np.inf))


def _lengths(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def free_axes(surface: Surface) -> Booleans:
    """The axes along which each vertex may move so that it stays on the faces of the box that hold it, bool [v, 3]."""
    free = np.ones((surface.n_vertices, 3), bool)
    on_box = np.flatnonzero(surface.box_faces >= 0)
    heads = half_edge_heads(surface.offsets, surface.corners)
    for vertices in (surface.corners[on_box], heads[on_box]):
        free[vertices, surface.box_faces[on_box] // 2] = False
    return free
