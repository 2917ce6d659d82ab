"""Newton's method for the vertices of a mesh: along the gradient onto the level set of the true network.

A step that does not lower |f| is shortened (Dennis and Schnabel, Numerical Methods for Unconstrained Optimization and
Nonlinear Equations, section 6.3). Close to the level set, where |f| falls fast, the gradient of the step before serves
once more. Vertices on faces of the box stay on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import run_matrix_blocks
from mn_onnx.extract.edges import half_edge_heads
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

STEPS = 24
CONVERGED = 1e-10
"""|f| relative to the slope times the box: nothing is gained beyond."""

SETTLED = 1e-8
"""The same: a vertex above found no root."""

FAST = 0.1
"""|f| that falls by this factor in a step is near its root: the gradient need not be computed again."""

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

        def work(first: int, last: int) -> None:
            part = slice(first * BLOCK, last * BLOCK)
            result[part] = self._evaluator.values(points[part])

        run_matrix_blocks(work, -(-len(points) // BLOCK), self._threads)
        return result

    def values_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """``f`` and its gradient at ``points`` [n, 3], float64 [n] and [n, 3]."""
        values, gradients = np.empty(len(points)), np.empty((len(points), 3))

        def work(first: int, last: int) -> None:
            part = slice(first * BLOCK, last * BLOCK)
            values[part], gradients[part] = self._evaluator.values_and_gradients(points[part])

        run_matrix_blocks(work, -(-len(points) // BLOCK), self._threads)
        return values, gradients


@dataclass(eq=False)
class Projection:
    """Vertices on their way onto the level set. ``positions`` [v, 3], ``values`` [v]: where they are, and ``f`` there.

    ``gradients`` [v, 3]: of ``f``, at the positions or within a short last step of them. ``free`` bool [v, 3]: the axes
    along which a vertex may move. ``slope``: the typical one.
    """

    field: TrueField
    lower: Floats
    upper: Floats
    positions: Floats
    values: Floats
    gradients: Floats
    free: Booleans
    slope: float

    @classmethod
    def of(cls, surface: Surface, field: TrueField, lower: Floats, upper: Floats) -> Projection:
        """The vertices of ``surface`` where they are."""
        values, gradients = field.values_and_gradients(surface.vertices)
        slope = float(np.median(_lengths(gradients))) if len(values) else 0.0
        return cls(field, lower, upper, surface.vertices.copy(), values, gradients, free_axes(surface), slope)

    @property
    def scale(self) -> float:
        """|f| across the box, of a field of the typical slope."""
        return self.slope * float((self.upper - self.lower).max())

    def settled(self) -> Booleans:
        """Which vertices are on the level set, up to rounding and the last bits of a Newton iteration."""
        return np.asarray(np.abs(self.values) <= SETTLED * self.scale)

    def insert(self, order: Integers, positions: Floats, free: Booleans) -> None:
        """Number the vertices anew, and take in others.

        ``order``: int64 [n], vertex ``i`` was vertex ``order[i]``, or is new from the number of old ones on;
        ``positions`` [n, 3], of which those of new ones are read; ``free`` [new, 3], of the new ones by rising ``i``.
        """
        new = order >= len(self.values)
        kept = order[~new]
        values, gradients, allowed = np.empty(order.size), np.empty((order.size, 3)), np.empty((order.size, 3), bool)
        values[~new], gradients[~new], allowed[~new] = self.values[kept], self.gradients[kept], self.free[kept]
        values[new], gradients[new] = self.field.values_and_gradients(positions[new])
        allowed[new] = free
        own = self.positions[kept]
        self.positions = positions.copy()
        self.positions[~new] = own
        self.values, self.gradients, self.free = values, gradients, allowed

    def evaluate(self, vertices: Integers) -> None:
        """Bring values and gradients of ``vertices`` up to date."""
        self.values[vertices], self.gradients[vertices] = self.field.values_and_gradients(self.positions[vertices])

    def project(self, vertices: Integers) -> None:
        """Move ``vertices``, whose values and gradients are up to date, onto the level set, as far as they find it."""
        start = self.positions[vertices]
        least = SHALLOW * self.slope
        steepness = _lengths(self.gradients[vertices] * self.free[vertices])
        reach = REACH * np.abs(self.values[vertices]) / np.maximum(steepness, max(least, np.finfo(np.float64).tiny))
        share = np.ones(len(vertices))
        fast = np.zeros(len(vertices), bool)
        at = np.flatnonzero(np.abs(self.values[vertices]) > CONVERGED * self.scale)
        for _ in range(STEPS):
            if not at.size:
                break
            for places in (at[fast[at]], at[~fast[at]]):
                if places.size:
                    self._step(vertices[places], start[places], reach[places], share, fast, places)
            at = at[(np.abs(self.values[vertices[at]]) > CONVERGED * self.scale) & (share[at] >= SHORTEST)]

    def _step(
        self, vertices: Integers, start: Floats, reach: Floats, share: Floats, fast: Booleans, places: Integers
    ) -> None:
        """One step of ``vertices``, all fast or none; ``share`` and ``fast`` are brought up to date at ``places``."""
        before, with_gradients = self.values[vertices], not fast[places[0]]
        positions = self.positions[vertices]
        directions = self.gradients[vertices] * self.free[vertices]
        # A vertex that meets a face of the box goes on along it.
        out = np.where((before > 0)[:, None], directions, -directions)
        directions[((positions <= self.lower) & (out > 0)) | ((positions >= self.upper) & (out < 0))] = 0.0
        squares = _lengths(directions) ** 2
        factor = share[places] * before / np.where(squares > 0, squares, np.inf)
        moves = positions - factor[:, None] * directions - start
        lengths = _lengths(moves)
        moves *= np.minimum(1.0, reach / np.where(lengths > 0, lengths, 1.0))[:, None]
        positions = np.clip(start + moves, self.lower, self.upper)
        if with_gradients:
            values, gradients = self.field.values_and_gradients(positions)
        else:
            values = self.field.values(positions)
        better = np.abs(values) < np.abs(before)
        moved = vertices[better]
        self.positions[moved], self.values[moved] = positions[better], values[better]
        if with_gradients:
            self.gradients[moved] = gradients[better]
            share[places] = np.where(better, 1.0, SHORTENING * share[places])
        fast[places] = np.abs(values) <= FAST * np.abs(before)


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
