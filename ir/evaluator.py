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

# Values of all variables of one chunk of points; small enough for the caches of a core.
CHUNK_BYTES = 1 << 20


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


class Evaluator:
    """A network prepared for evaluation at many points.

    ``true_functions``: evaluate the units' true functions even where they have a table.
    """

    def __init__(self, network: Network, *, true_functions: bool = False) -> None:
        self.network = network
        self.levels = [(block, _groups(network, block, true_functions)) for block in level_blocks(network)]

    def chunks(self, points: Floats) -> Iterator[slice]:
        """Slices of ``points`` that are evaluated at a time, so that memory stays bounded."""
        size = max(64, CHUNK_BYTES // (8 * max(1, self.network.n_variables)))
        yield from (slice(start, start + size) for start in range(0, points.shape[0], size))

    def forward(self, points: Floats) -> tuple[Floats, list[Floats]]:
        """Values of all variables [n, v], and the pre-activations [n, u] of each level."""
        variables = np.empty((points.shape[0], self.network.n_variables))
        variables[:, : self.network.input_dim] = points
        pre_activations = []
        for block, groups in self.levels:
            t = variables[:, contiguous(block.columns)] @ block.weights.T + block.bias
            for group in groups:
                variables[:, group.outputs] = group.function.values(t[:, group.positions])
            pre_activations.append(t)
        return variables, pre_activations

    def values(self, points: Floats) -> Floats:
        """``f`` at ``points`` (float64 [n, input_dim]), float64 [n]."""
        points = validated_points(self.network, points)
        output = self.network.output
        result = np.empty(points.shape[0])
        for chunk in self.chunks(points):
            variables, _ = self.forward(points[chunk])
            result[chunk] = variables[:, contiguous(output.columns)] @ output.weights + output.bias
        return result

    def gradients(self, points: Floats) -> Floats:
        """The gradient of ``f`` at ``points`` (float64 [n, input_dim]), float64 [n, input_dim]."""
        return self.values_and_gradients(points)[1]

    def values_and_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """`values` and `gradients` at ``points`` (float64 [n, input_dim]) in one pass."""
        points = validated_points(self.network, points)
        output = self.network.output
        values, gradients = np.empty(points.shape[0]), np.empty_like(points)
        for chunk in self.chunks(points):
            variables, pre_activations = self.forward(points[chunk])
            values[chunk] = variables[:, contiguous(output.columns)] @ output.weights + output.bias
            gradients[chunk] = self._backward(pre_activations, values[chunk].size)
        return values, gradients

    def _backward(self, pre_activations: list[Floats], n_points: int) -> Floats:
        adjoint = np.zeros((n_points, self.network.n_variables))
        adjoint[:, self.network.output.columns] = self.network.output.weights
        for (block, groups), t in zip(reversed(self.levels), reversed(pre_activations), strict=True):
            of_t = np.zeros_like(t)
            for group in groups:
                slopes = group.function.slopes(t[:, group.positions])
                slopes *= adjoint[:, group.outputs]
                _accumulate(of_t, group.positions, slopes)
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
