"""Networks prepared for evaluation at many points: dense levels, units with like functions side by side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mn_onnx.ir import scalar
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, KnotTable, Network, Unit
from mn_onnx.ir.ranges import RangeMaximum
from mn_onnx.ir.scalar.derivative import derivative

CHUNK = 1 << 17
"""Pre-activations of a level that are evaluated at a time: what a core's caches hold; with less, threads wait."""

FEWEST_POINTS = 64
"""... but of at least so many points, which a product of matrices needs to be fast."""


@dataclass(frozen=True, eq=False)
class Hinges:
    """One-output tables with at most one knot, side by side: parameters [h] each."""

    knots: Floats
    left: tuple[Floats, Floats]
    right: tuple[Floats, Floats]

    @property
    def steepness(self) -> Floats:
        """The largest |slope| of each."""
        return np.maximum(np.abs(self.left[0]), np.abs(self.right[0]))

    @cached_property
    def _are_rectifiers(self) -> bool:
        through_origin = not (self.knots.any() or self.left[1].any() or self.right[1].any())
        return through_origin and not self.left[0].any() and bool((self.right[0] == 1).all())

    def values(self, t: Floats) -> Floats:
        """Values [n, h] at pre-activations [n, h]."""
        if self._are_rectifiers:
            return np.maximum(t, 0.0)
        return np.where(t >= self.knots, self.right[0] * t + self.right[1], self.left[0] * t + self.left[1])

    def slopes(self, t: Floats) -> Floats:
        """Slopes [n, h] at pre-activations [n, h]."""
        if self._are_rectifiers:
            return (t >= 0.0).astype(np.float64)
        return np.where(t >= self.knots, self.right[0], self.left[0])

    def slopes_between(self, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
        """The smallest and largest slopes on ``[lower, upper]``."""
        at_lower, at_upper = self.slopes(lower), self.slopes(upper)
        return np.minimum(at_lower, at_upper), np.maximum(at_lower, at_upper)


@dataclass(frozen=True, eq=False)
class TableOutput:
    """One output of a table, applied to several units that share it."""

    knots: Floats
    slope: Floats
    intercept: Floats

    @property
    def steepness(self) -> float:
        """The largest |slope|."""
        return float(np.abs(self.slope).max())

    def values(self, t: Floats) -> Floats:
        interval = np.searchsorted(self.knots, t, side="right")
        return self.slope[interval] * t + self.intercept[interval]

    def slopes(self, t: Floats) -> Floats:
        """Slopes at ``t``."""
        return self.slope[np.searchsorted(self.knots, t, side="right")]

    def slopes_between(self, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
        """The smallest and largest slopes on ``[lower, upper]``."""
        first, last = (np.searchsorted(self.knots, t, side="right") for t in (lower, upper))
        return -RangeMaximum(-self.slope)(first, last), RangeMaximum(self.slope)(first, last)


@dataclass(frozen=True, eq=False)
class SmoothFunction:
    """An expression, applied to several units that share it."""

    expression: Expression

    def values(self, t: Floats) -> Floats:
        return scalar.evaluate(self.expression, t)

    def slopes(self, t: Floats) -> Floats:
        return scalar.evaluate(derivative(self.expression), t)


@dataclass(frozen=True, eq=False)
class FunctionGroup:
    """One vectorised function: from the pre-activations at ``positions`` of a level to the variables ``outputs``."""

    positions: slice | Integers
    outputs: slice | Integers
    function: Hinges | TableOutput | SmoothFunction


def _scalar_functions(unit: Unit, true_functions: bool) -> Iterator[tuple[KnotTable, int] | Expression]:
    for index, function in enumerate(unit.functions):
        if unit.table is not None and not true_functions:
            yield unit.table, index
        elif isinstance(function, Expression):
            yield function
        else:
            yield function, 0


def _groups(network: Network, block: LevelBlock, true_functions: bool) -> list[FunctionGroup]:
    hinges: list[tuple[int, int, KnotTable, int]] = []
    shared: dict[object, tuple[TableOutput | SmoothFunction, list[tuple[int, int]]]] = {}
    for position, index in enumerate(block.units):
        first = int(network.first_variable[index])
        for offset, function in enumerate(_scalar_functions(network.units[index], true_functions)):
            place = (position, first + offset)
            if isinstance(function, Expression):
                shared.setdefault(function, (SmoothFunction(function), []))[1].append(place)
                continue
            table, output = function
            if table.knots.size <= 1:
                hinges.append((*place, table, output))
            else:
                slope, intercept = table.slopes[output], table.intercepts[output]
                key = (table.knots.tobytes(), slope.tobytes(), intercept.tobytes())
                shared.setdefault(key, (TableOutput(table.knots, slope, intercept), []))[1].append(place)
    groups = [
        FunctionGroup(
            contiguous(np.array([p for p, _ in places])), contiguous(np.array([o for _, o in places])), function
        )
        for function, places in shared.values()
    ]
    if hinges:
        positions, outputs = (np.array(part) for part in zip(*((p, o) for p, o, _, _ in hinges), strict=True))
        tables = [(table, output) for _, _, table, output in hinges]
        knots = np.array([table.knots[0] if table.knots.size else 0.0 for table, _ in tables])
        left, right = (
            (
                np.array([table.slopes[output, side] for table, output in tables]),
                np.array([table.intercepts[output, side] for table, output in tables]),
            )
            for side in (0, -1)
        )
        groups.append(FunctionGroup(contiguous(positions), contiguous(outputs), Hinges(knots, left, right)))
    return groups


@dataclass(frozen=True, eq=False)
class _Buffers:
    """Memory for one chunk of points, used again for the next: fresh pages cost more than what is computed on them.

    ``variables``, ``adjoint`` [n, v]; ``pre_activations``, ``of_t`` [n, u] for each level.
    """

    variables: Floats
    adjoint: Floats
    pre_activations: list[Floats]
    of_t: list[Floats]

    def rows(self, n: int) -> _Buffers:
        """Those of the first ``n`` points."""
        return _Buffers(
            self.variables[:n], self.adjoint[:n], [t[:n] for t in self.pre_activations], [t[:n] for t in self.of_t]
        )


class Evaluator:
    """A network prepared for evaluation at many points.

    ``true_functions``: evaluate the units' true functions even where they have a table.
    """

    def __init__(self, network: Network, *, true_functions: bool = False) -> None:
        self.network = network
        self.levels = [(block, _groups(network, block, true_functions)) for block in level_blocks(network)]

    def values(self, points: Floats) -> Floats:
        """``f`` at ``points`` (float64 [n, input_dim]), float64 [n]."""
        points = validated_points(self.network, points)
        result = np.empty(points.shape[0])
        for chunk, buffers in self._chunks_with_buffers(points, with_gradients=False):
            self._forward(points[chunk], buffers)
            result[chunk] = self._output(buffers)
        return result

    def gradients(self, points: Floats) -> Floats:
        """The gradient of ``f`` at ``points`` (float64 [n, input_dim]), float64 [n, input_dim]."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """`values` and `gradients` at ``points`` (float64 [n, input_dim]) in one pass."""
        points = validated_points(self.network, points)
        values, gradients = np.empty(points.shape[0]), np.empty_like(points)
        for chunk, buffers in self._chunks_with_buffers(points, with_gradients=True):
            self._forward(points[chunk], buffers)
            values[chunk] = self._output(buffers)
            gradients[chunk] = self._backward(buffers)
        return values, gradients

    def chunks(self, points: Floats) -> Iterator[slice]:
        """Slices of ``points`` to evaluate at a time."""
        size = self._chunk_size(points)
        yield from (slice(start, start + size) for start in range(0, points.shape[0], size))

    def _chunk_size(self, points: Floats) -> int:
        widest = max((block.bias.size for block, _ in self.levels), default=1)
        size: int = min(max(FEWEST_POINTS, CHUNK // widest), max(1, points.shape[0]))
        return size

    def _chunks_with_buffers(self, points: Floats, *, with_gradients: bool) -> Iterator[tuple[slice, _Buffers]]:
        """`chunks`, each with memory for it."""
        size, n_variables = self._chunk_size(points), self.network.n_variables
        widths = [block.bias.size for block, _ in self.levels]
        buffers = _Buffers(
            np.empty((size, n_variables)),
            np.empty((size, n_variables if with_gradients else 0)),
            [np.empty((size, width)) for width in widths],
            [np.empty((size, width if with_gradients else 0)) for width in widths],
        )
        for chunk in self.chunks(points):
            yield chunk, buffers.rows(min(size, points.shape[0] - chunk.start))

    def _forward(self, points: Floats, buffers: _Buffers) -> None:
        """Fill in the values of all variables and the pre-activations."""
        variables = buffers.variables
        variables[:, : self.network.input_dim] = points
        for (block, groups), t in zip(self.levels, buffers.pre_activations, strict=True):
            np.matmul(variables[:, contiguous(block.columns)], block.weights.T, out=t)
            t += block.bias
            for group in groups:
                variables[:, group.outputs] = group.function.values(t[:, group.positions])

    def _output(self, buffers: _Buffers) -> Floats:
        output = self.network.output
        result: Floats = buffers.variables[:, contiguous(output.columns)] @ output.weights + output.bias
        return result

    def _backward(self, buffers: _Buffers) -> Floats:
        """The gradients with respect to the points, after `_forward`."""
        adjoint, output = buffers.adjoint, self.network.output
        adjoint[...] = 0.0
        adjoint[:, output.columns] = output.weights
        backward = zip(reversed(self.levels), reversed(buffers.pre_activations), reversed(buffers.of_t), strict=True)
        for (block, groups), t, of_t in backward:
            of_t[...] = 0.0
            for group in groups:
                slopes = group.function.slopes(t[:, group.positions])
                slopes *= adjoint[:, group.outputs]
                _accumulate(of_t, group.positions, slopes)
            # A function without a derivative somewhere has NaN there, and so has the gradient.
            with np.errstate(invalid="ignore"):
                adjoint[:, contiguous(block.columns)] += of_t @ block.weights
        return adjoint[:, : self.network.input_dim]


def _accumulate(target: Floats, positions: slice | Integers, terms: Floats) -> None:
    if isinstance(positions, slice):
        target[:, positions] += terms
    else:
        # Positions repeat where a unit has several outputs of one kind.
        np.add.at(target.T, positions, terms.T)


def validated_points(network: Network, points: Floats) -> Floats:
    """``points`` as contiguous float64 [n, input_dim]; raises ``ValueError`` for another shape."""
    points = np.ascontiguousarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != network.input_dim:
        raise ValueError(f"points must be [n, {network.input_dim}], not {list(points.shape)}")
    return points
