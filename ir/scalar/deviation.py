"""Rigorous enclosures of the deviation of a function from straight lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats, Integers
from mn_onnx.ir.scalar import interval
from mn_onnx.ir.scalar.interval import Interval
from mn_onnx.ir.scalar.jet import Jet, jet
from mn_onnx.ir.scalar.kinks import is_finest

CELLS_PER_INTERVAL = 4
MOST_ROUNDS = 64
MOST_CELLS = 1 << 18
# Enclosures are refined until they are this close to a value that the deviation attains, relative to its spread ...
RELATIVE_GAP = 0.005
# ... or to this fraction of the function's size, below which rounding decides.
SMALLEST_GAP = 2.0**-44


class _CellBounds(NamedTuple):
    """Bounds of the deviation over each cell; values it attains, as far as rounding tells; the size of the numbers."""

    low: Floats
    high: Floats
    attained_low: Floats
    attained_high: Floats
    scale: Floats


def _node_deviation(value: Interval, t: Floats, slope: Floats, intercept: Floats) -> Interval:
    line = interval.add(interval.multiply(interval.point(slope), interval.point(t)), interval.point(intercept))
    return interval.subtract(value, line)


def _bulge(enclosure: Jet, width: Floats, limit: Interval) -> Interval:
    """How far the deviation may leave the range of its values at the ends of a cell of this width.

    A function with curvature in [a, b] stays within ``width**2 / 8`` times that of its chord (interpolation error), one
    with slope in [p, q] within ``width * (q - p) / 4``; ``limit`` is what its values alone say.
    """
    by_curvature = width * width / 8
    below = np.fmin(by_curvature * np.maximum(enclosure.curvature.upper, 0.0), width / 4 * enclosure.slope.width)
    above = np.fmin(by_curvature * np.maximum(-enclosure.curvature.lower, 0.0), width / 4 * enclosure.slope.width)
    # A zero width times an unbounded derivative is undefined; the values alone then bound the deviation.
    grow = 1 + 8 * np.finfo(np.float64).eps
    return Interval(
        -np.minimum(np.where(np.isnan(below), np.inf, below * grow), -limit.lower),
        np.minimum(np.where(np.isnan(above), np.inf, above * grow), limit.upper),
    )


def deviation(
    expression: Expression, lower: Floats, upper: Floats, slope: Floats, intercept: Floats
) -> tuple[Interval, Interval]:
    """Enclosures of ``expression(t) - (slope * t + intercept)`` over ``[lower, upper]``; all arrays float64 [n].

    Returns two intervals [n]: one that surely contains the deviation, and one that it surely fills up to rounding (the
    values at sampled points). They differ by `RELATIVE_GAP` at most, unless the function jumps or is unbounded.
    """
    n = lower.size
    steps = np.linspace(0.0, 1.0, CELLS_PER_INTERVAL + 1)
    edges = lower[:, None] + (upper - lower)[:, None] * steps
    edges[:, -1] = upper
    owner = np.repeat(np.arange(n), CELLS_PER_INTERVAL)
    low, high = edges[:, :-1].ravel(), edges[:, 1:].ravel()
    attained_low, attained_high = np.full(n, np.inf), np.full(n, -np.inf)
    sure_low, sure_high = np.full(n, np.inf), np.full(n, -np.inf)
    for round_number in range(MOST_ROUNDS):
        with np.errstate(all="ignore"):
            cells = _cell_bounds(expression, low, high, slope[owner], intercept[owner])
        np.minimum.at(attained_low, owner, cells.attained_low)
        np.maximum.at(attained_high, owner, cells.attained_high)
        gap = RELATIVE_GAP * np.maximum(attained_high - attained_low, 0.0)[owner] + SMALLEST_GAP * cells.scale
        gap += np.finfo(np.float64).tiny  # where the function is zero throughout, of which nothing is a fraction
        settled = (cells.high <= attained_high[owner] + gap) & (cells.low >= attained_low[owner] - gap)
        settled |= is_finest(low, high, 0.0) | ~np.isfinite(cells.scale)
        if round_number == MOST_ROUNDS - 1 or 2 * (~settled).sum() > MOST_CELLS:
            settled[:] = True
        np.minimum.at(sure_low, owner[settled], cells.low[settled])
        np.maximum.at(sure_high, owner[settled], cells.high[settled])
        low, high, owner = _halve(low[~settled], high[~settled], owner[~settled])
        if not low.size:
            break
    return Interval(sure_low, sure_high), Interval(attained_low, attained_high)


def _halve(low: Floats, high: Floats, owner: Integers) -> tuple[Floats, Floats, Integers]:
    middle = 0.5 * low + 0.5 * high
    return np.concatenate([low, middle]), np.concatenate([middle, high]), np.concatenate([owner, owner])


def _cell_bounds(expression: Expression, low: Floats, high: Floats, slope: Floats, intercept: Floats) -> _CellBounds:
    # Cells, left ends and right ends in one go: for few cells the number of array operations is what costs.
    n = low.size
    together = jet(expression, np.concatenate([low, low, high]), np.concatenate([high, low, high]))
    enclosure = together[:n]
    left = _node_deviation(together.value[n : 2 * n], low, slope, intercept)
    right = _node_deviation(together.value[2 * n :], high, slope, intercept)
    ends = interval.hull(left, right)
    t = Interval(low, high)
    line = interval.add(interval.multiply(interval.point(slope), t), interval.point(intercept))
    by_value = interval.subtract(enclosure.value, line)
    limit = Interval(np.fmin(by_value.lower - ends.lower, 0.0), np.fmax(by_value.upper - ends.upper, 0.0))
    bulge = _bulge(enclosure, high - low, limit)
    cell_low = np.where(np.isfinite(ends.lower), ends.lower + bulge.lower, -np.inf)
    cell_high = np.where(np.isfinite(ends.upper), ends.upper + bulge.upper, np.inf)
    return _CellBounds(
        np.nextafter(cell_low, -np.inf),
        np.nextafter(cell_high, np.inf),
        np.minimum(left.upper, right.upper),
        np.maximum(left.lower, right.lower),
        np.maximum(left.magnitude, right.magnitude) + line.magnitude,
    )
