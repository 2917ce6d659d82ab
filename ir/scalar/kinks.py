"""Where a scalar function may have kinks, and where it jumps or is undefined."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mn_onnx.ir.expression import Expression, apply
from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar.evaluate import evaluate
from mn_onnx.ir.scalar.jet import jet
from mn_onnx.ir.scalar.piecewise import NotPiecewisePolynomial, piecewise
from mn_onnx.ir.scalar.rewrite import rewrite

FIRST_CELLS = 64
MOST_CELLS = 4096
# Cells of this many units in the last place, or this fraction of the range, are not divided further.
FINEST_ULPS = 4
FINEST_FRACTION = 2.0**-64


class UndefinedFunction(ValueError):
    """A scalar function jumps, is unbounded or undefined on the range it is needed on."""


def _require_range(lower: float, upper: float) -> None:
    if not (np.isfinite(lower) and np.isfinite(upper) and lower <= upper):
        raise ValueError(f"the range of a scalar function must be finite, not [{lower}, {upper}]")


def _first_cells(lower: float, upper: float) -> tuple[Floats, Floats]:
    edges = np.unique(np.linspace(lower, upper, FIRST_CELLS + 1))
    return (edges[:-1], edges[1:]) if edges.size > 1 else (edges, edges)


def halve(lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Both halves of every interval, in order."""
    middle = 0.5 * lower + 0.5 * upper
    return np.column_stack([lower, middle]).ravel(), np.column_stack([middle, upper]).ravel()


def is_finest(lower: Floats, upper: Floats, whole_range: float) -> np.ndarray:
    """Whether intervals are too narrow to be divided, in float64 or beside the range they are part of."""
    resolution = FINEST_ULPS * np.spacing(np.maximum(np.abs(lower), np.abs(upper)))
    finest: np.ndarray = upper - lower <= np.maximum(resolution, FINEST_FRACTION * whole_range)
    return finest


def _switches(expression: Expression) -> Iterator[Expression]:
    """The functions whose changes of sign make ``expression`` change its form."""
    if expression.op in ("abs", "sign"):
        yield expression.arguments[0]
    elif expression.op in ("maximum", "minimum", "less", "less_equal", "equal"):
        yield apply("subtract", *expression.arguments)
    for argument in expression.arguments:
        yield from _switches(argument)


def breakpoints(expression: Expression, lower: float, upper: float) -> Floats:
    """Sorted float64 points strictly inside ``(lower, upper)`` where ``expression`` may have a kink or a jump.

    They are the thresholds of ``abs``, ``sign``, ``max``, ``min`` and comparisons: exact (rounded once) where the
    compared functions are piecewise linear, else isolated with interval arithmetic to a few units in the last place.
    Raises ``ValueError`` for an infinite range.
    """
    _require_range(lower, upper)
    found: list[float] = []
    for switch in dict.fromkeys(_switches(rewrite(expression))):
        try:
            signs = piecewise(apply("sign", switch))
            found.extend(float(knot) for knot in signs.knots)
        except NotPiecewisePolynomial:
            found.extend(_roots(switch, lower, upper))
    points = np.unique(np.array(found, np.float64))
    return points[(points > lower) & (points < upper)]


def _roots(expression: Expression, lower: float, upper: float) -> list[float]:
    """Every root of ``expression``, within a few units in the last place; touching roots too."""
    low, high = _first_cells(lower, upper)
    roots: list[float] = []
    while low.size:
        enclosure = jet(expression, low, high)
        may_vanish = (enclosure.value.lower <= 0) & (enclosure.value.upper >= 0)
        low, high = low[may_vanish], high[may_vanish]
        slope_lower, slope_upper = enclosure.slope.lower[may_vanish], enclosure.slope.upper[may_vanish]
        monotone = (slope_lower > 0) | (slope_upper < 0)
        roots.extend(_bisect(expression, low[monotone], high[monotone], upper - lower).tolist())
        low, high = low[~monotone], high[~monotone]
        finest = is_finest(low, high, upper - lower)
        roots.extend((0.5 * (low[finest] + high[finest])).tolist())
        if 2 * low.size > MOST_CELLS:
            raise UndefinedFunction(
                f"it changes form more often than {MOST_CELLS // 2} times on [{lower:.6g}, {upper:.6g}]"
            )
        low, high = halve(low[~finest], high[~finest])
    return roots


def _bisect(expression: Expression, lower: Floats, upper: Floats, whole_range: float) -> Floats:
    """Roots of a function that is monotone on each interval, for the intervals at whose ends its signs differ."""
    at_lower, at_upper = evaluate(expression, lower), evaluate(expression, upper)
    crosses = at_lower * at_upper <= 0
    low, high, sign = lower[crosses], upper[crosses], np.sign(at_lower[crosses])
    while low.size and not is_finest(low, high, whole_range).all():
        middle = 0.5 * low + 0.5 * high
        on_left = np.sign(evaluate(expression, middle)) == sign
        low, high = np.where(on_left, middle, low), np.where(on_left, high, middle)
    return 0.5 * low + 0.5 * high


def discontinuities(
    expression: Expression, lower: float, upper: float, *, tolerance: float = 1e-6, limit: int = 64
) -> tuple[float, ...]:
    """Points of ``[lower, upper]`` where ``expression`` jumps by more than ``tolerance``, is unbounded or undefined.

    ``tolerance`` is relative to the larger of one and the function's values nearby: branches that were joined with
    rounded constants (Softplus with a threshold) miss each other by less. An empty result proves that there is no
    such point. Sorted; search ends once ``limit`` points are known. Raises ``ValueError`` for an infinite range.
    """
    _require_range(lower, upper)
    low, high = _first_cells(lower, upper)
    found: list[float] = []
    while low.size and len(found) < limit:
        middle = 0.5 * low + 0.5 * high
        undefined = ~np.isfinite(evaluate(expression, middle))
        enclosure = jet(expression, low, high)
        with np.errstate(invalid="ignore"):
            allowed = tolerance * np.maximum(1.0, np.minimum(enclosure.value.magnitude, 1e300))
            settled = enclosure.slope.is_bounded | (enclosure.value.width <= allowed)
        finest = is_finest(low, high, upper - lower)
        found.extend(middle[undefined | (finest & ~settled)].tolist())
        remaining = ~(undefined | settled | finest)
        if 2 * remaining.sum() > MOST_CELLS:
            # A dense set of jumps: the first ones say enough, and following all would not end.
            remaining &= np.cumsum(remaining) <= limit
        low, high = halve(low[remaining], high[remaining])
    return tuple(sorted(found)[:limit])
