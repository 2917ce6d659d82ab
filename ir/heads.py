"""Inversion of monotone scalar functions at one value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir import scalar
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar.jet import jet
from mn_onnx.ir.scalar.kinks import halve, is_finest

FIRST_CELLS = 64
MOST_CELLS = 4096
# Outward rounding makes a slope of zero this small a negative number at most.
ROUNDED_ZERO = 1e-290


@dataclass(frozen=True)
class Inverse:
    """Where a function takes a value.

    ``direction``: 1 if it increases there, -1 if it decreases, 0 if it cannot be inverted there (``argument`` is then
    meaningless). ``reason``: why the value is taken nowhere, "" if that is not known.
    """

    argument: float = 0.0
    direction: int = 0
    reason: str = ""


def invert_table(table: KnotTable, target: float) -> Inverse:
    """Invert a one-output ``table`` at ``target``: possible where it takes the value once, not on a constant piece."""
    knots, slopes, intercepts = table.knots, table.slopes[0], table.intercepts[0]
    values = slopes[:-1] * knots + intercepts[:-1]
    rising, falling = bool((slopes >= 0).all()), bool((slopes <= 0).all())
    least = -np.inf if slopes[0] > 0 or slopes[-1] < 0 else values.min(initial=np.inf)
    greatest = np.inf if slopes[-1] > 0 or slopes[0] < 0 else values.max(initial=-np.inf)
    if target < least or target > greatest:
        return Inverse(reason=f"values lie between {least:.9g} and {greatest:.9g} only")
    if rising == falling:
        return Inverse()
    ordered = values if rising else values[::-1]
    position = int(np.searchsorted(ordered, target, side="left"))
    at_knot = position < knots.size and ordered[position] == target
    interval = position if rising else knots.size - position
    if at_knot:
        # At a knot the pieces on both sides must be strictly monotone for the solution to be one point.
        knot = position if rising else knots.size - 1 - position
        if not (slopes[knot] and slopes[knot + 1]):
            return Inverse()
        return Inverse(float(knots[knot]), 1 if rising else -1)
    slope = slopes[interval]
    if not slope:
        return Inverse()
    return Inverse(float((target - intercepts[interval]) / slope), 1 if rising else -1)


def monotonicity(expression: Expression, lower: float, upper: float) -> int:
    """1 if ``expression`` is proved never to fall on ``[lower, upper]``, -1 never to rise, 0 if neither is proved."""
    ends = scalar.evaluate(expression, np.array([lower, upper]))
    direction = 1 if ends[1] > ends[0] else -1
    edges = np.linspace(lower, upper, FIRST_CELLS + 1)
    low, high = edges[:-1], edges[1:]
    while low.size:
        slope = jet(expression, low, high).slope
        proved = slope.lower >= -ROUNDED_ZERO if direction > 0 else slope.upper <= ROUNDED_ZERO
        contradicted = slope.upper < 0 if direction > 0 else slope.lower > 0
        # A cell as narrow as rounding allows is a kink that no enclosure can resolve; its ends are compared instead.
        finest = is_finest(low, high, upper - lower) & ~proved
        steps = scalar.evaluate(expression, high[finest]) - scalar.evaluate(expression, low[finest])
        size = np.abs(scalar.evaluate(expression, low[finest])) + np.abs(low[finest])
        if contradicted.any() or (direction * steps < -8 * np.finfo(np.float64).eps * size).any():
            return 0
        remaining = ~(proved | finest)
        if 2 * remaining.sum() > MOST_CELLS:
            return 0
        low, high = halve(low[remaining], high[remaining])
    return direction


def invert_expression(expression: Expression, target: float, lower: float, upper: float) -> Inverse:
    """Invert ``expression`` at ``target`` on ``[lower, upper]``, by bisection to the last bit of the argument."""
    edges = np.linspace(lower, upper, FIRST_CELLS + 1)
    values = jet(expression, edges[:-1], edges[1:]).value
    least, greatest = values.lower.min(), values.upper.max()
    if not least <= target <= greatest:
        return Inverse(reason=f"values on its range over the box lie between {least:.9g} and {greatest:.9g} only")
    direction = monotonicity(expression, lower, upper) if upper > lower else 0
    if not direction or scalar.discontinuities(expression, lower, upper):
        return Inverse()
    ends = jet(expression, np.array([lower, upper]), np.array([lower, upper])).value
    at_least, at_greatest = (0, 1) if direction > 0 else (1, 0)
    # Beyond or within rounding of the end values: a saturated function never reaches its limit.
    if not ends.upper[at_least] < target < ends.lower[at_greatest]:
        return Inverse(reason=f"values on its range over the box lie between {least:.9g} and {greatest:.9g} only")
    # Rounding makes the function take its target on a whole interval of arguments; the middle is the best of them,
    # and zero, where it is one of them, surely meant.
    first = _last_before(expression, lower, upper, lambda value: direction * (value - target) < 0)
    last = _last_before(expression, lower, upper, lambda value: direction * (value - target) <= 0)
    argument = 0.0 if first < 0.0 < last else 0.5 * first + 0.5 * last
    return Inverse(argument, direction)


def _last_before(expression: Expression, lower: float, upper: float, is_before: Callable[[float], bool]) -> float:
    """The last argument, to the last bit, at which a monotone function ``is_before`` some value."""
    low, high = lower, upper
    while True:
        middle = 0.5 * low + 0.5 * high
        if not low < middle < high:
            return low
        if is_before(float(scalar.evaluate(expression, np.array(middle)))):
            low = middle
        else:
            high = middle
