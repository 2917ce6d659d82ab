"""Enclosures of an expression's value, slope and curvature over intervals of its variable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar import interval
from mn_onnx.ir.scalar.elementary import HALF_LINE, SMOOTH, enclose
from mn_onnx.ir.scalar.interval import Interval
from mn_onnx.ir.scalar.rewrite import rewrite


@dataclass(frozen=True, eq=False)
class Jet:
    """Enclosures over intervals [n]: ``value``, and ``slope`` and ``curvature`` wherever these exist.

    Where the function may have a kink the curvature is unbounded; where it may jump, the slope is too. A bounded slope
    proves continuity, a bounded curvature a continuous derivative.
    """

    value: Interval
    slope: Interval
    curvature: Interval

    def __getitem__(self, where: slice) -> Jet:
        return Jet(self.value[where], self.slope[where], self.curvature[where])


@dataclass(frozen=True, eq=False)
class Truth:
    """Whether a condition surely, or possibly, holds over each interval; bool [n]."""

    certain: np.ndarray
    possible: np.ndarray


def jet(expression: Expression, lower: Floats, upper: Floats) -> Jet:
    """Enclosures of ``expression`` over the intervals ``[lower, upper]`` (float64 [n] each), rounded outward."""
    t = Interval(np.asarray(lower, np.float64), np.asarray(upper, np.float64))
    with np.errstate(all="ignore"):
        result = _jet(rewrite(expression), t, {})
    assert isinstance(result, Jet)
    return result


def _jet(expression: Expression, t: Interval, known: dict[Expression, Jet | Truth]) -> Jet | Truth:
    shape = t.lower.shape
    if expression.op == "t":
        return Jet(t, interval.full(1.0, shape), interval.full(0.0, shape))
    if expression.op == "constant":
        return _constant(expression.value, shape)
    if expression not in known:
        arguments = [_jet(argument, t, known) for argument in expression.arguments]
        known[expression] = _apply(expression, arguments)
    return known[expression]


def _constant(value: float, shape: tuple[int, ...]) -> Jet:
    return Jet(interval.full(value, shape), interval.full(0.0, shape), interval.full(0.0, shape))


def _apply(expression: Expression, arguments: list[Jet | Truth]) -> Jet | Truth:
    op = expression.op
    if op == "where":
        return _where(_truth(arguments[0]), _real(arguments[1]), _real(arguments[2]))
    if op in ("and", "or", "not"):
        return _logic(op, [_truth(argument) for argument in arguments])
    jets = [_real(argument) for argument in arguments]
    if op in ("less", "less_equal", "equal"):
        return _compare(op, jets[0].value, jets[1].value)
    if op == "power":
        exponent = expression.arguments[1]
        return _power(jets[0], exponent.value if exponent.op == "constant" else None)
    if op in SMOOTH or op in HALF_LINE or op in ("sin", "cos", "tan"):
        return _chain(jets[0], enclose(op, jets[0].value))
    return ARITHMETIC[op](*jets)


def _real(argument: Jet | Truth) -> Jet:
    assert isinstance(argument, Jet), "a truth value stands where a number belongs"
    return argument


def _truth(argument: Jet | Truth) -> Truth:
    if isinstance(argument, Truth):
        return argument
    # A condition on constants alone has been folded into a number.
    value = argument.value
    return Truth((value.lower > 0) | (value.upper < 0), (value.lower != 0) | (value.upper != 0))


def _chain(inner: Jet, outer: tuple[Interval, Interval, Interval]) -> Jet:
    """``f(g)``: slope ``f' g'``, curvature ``f'' g'**2 + f' g''``."""
    value, slope, curvature = outer
    return Jet(
        value,
        interval.multiply(slope, inner.slope),
        interval.add(
            interval.multiply(curvature, interval.square(inner.slope)), interval.multiply(slope, inner.curvature)
        ),
    )


def _add(a: Jet, b: Jet) -> Jet:
    return Jet(interval.add(a.value, b.value), interval.add(a.slope, b.slope), interval.add(a.curvature, b.curvature))


def _negate(a: Jet) -> Jet:
    return Jet(interval.negate(a.value), interval.negate(a.slope), interval.negate(a.curvature))


def _subtract(a: Jet, b: Jet) -> Jet:
    return _add(a, _negate(b))


def _multiply(a: Jet, b: Jet) -> Jet:
    cross = interval.multiply(a.slope, b.slope)
    outer = interval.add(interval.multiply(a.curvature, b.value), interval.multiply(a.value, b.curvature))
    return Jet(
        interval.multiply(a.value, b.value),
        interval.add(interval.multiply(a.slope, b.value), interval.multiply(a.value, b.slope)),
        interval.add(outer, interval.add(cross, cross)),
    )


def _reciprocal(a: Jet) -> Jet:
    value = interval.reciprocal(a.value)
    squared = interval.square(value)
    cubed = interval.multiply(squared, value)
    return _chain(a, (value, interval.negate(squared), interval.add(cubed, cubed)))


def _divide(a: Jet, b: Jet) -> Jet:
    return _multiply(a, _reciprocal(b))


def _power(a: Jet, exponent: float | None) -> Jet:
    shape = a.value.lower.shape
    if exponent is None:
        return Jet(interval.whole(shape), interval.whole(shape), interval.whole(shape))
    values = [_real_power(a.value, exponent - order) for order in range(3)]
    slope = interval.multiply(interval.full(exponent, shape), values[1])
    factor = interval.multiply(interval.full(exponent, shape), interval.full(exponent - 1.0, shape))
    return _chain(a, (values[0], slope, interval.multiply(factor, values[2])))


def _real_power(x: Interval, exponent: float) -> Interval:
    if exponent.is_integer() and abs(exponent) <= 64:
        result = interval.integer_power(x, int(abs(exponent)))
        return result if exponent >= 0 else interval.reciprocal(result)
    # Defined for positive arguments, and monotone there.
    outside = x.lower < 0
    inside = Interval(np.maximum(x.lower, 0.0), np.maximum(x.upper, 0.0))
    ends = inside.lower**exponent, inside.upper**exponent
    enclosure = interval.outward_elementary(np.minimum(*ends), np.maximum(*ends))
    return interval.select(outside, interval.whole(x.lower.shape), enclosure)


def _choose(a_wins: np.ndarray, b_wins: np.ndarray, a: Jet, b: Jet, value: Interval, slope: Interval) -> Jet:
    """``a`` or ``b`` where decided, else the given enclosures with unbounded curvature."""
    unknown = interval.whole(a_wins.shape)
    return Jet(
        interval.select(a_wins, a.value, interval.select(b_wins, b.value, value)),
        interval.select(a_wins, a.slope, interval.select(b_wins, b.slope, slope)),
        interval.select(a_wins, a.curvature, interval.select(b_wins, b.curvature, unknown)),
    )


def _maximum(a: Jet, b: Jet) -> Jet:
    value = Interval(np.maximum(a.value.lower, b.value.lower), np.maximum(a.value.upper, b.value.upper))
    a_wins = a.value.lower >= b.value.upper
    b_wins = b.value.lower >= a.value.upper
    return _choose(a_wins, b_wins, a, b, value, interval.hull(a.slope, b.slope))


def _minimum(a: Jet, b: Jet) -> Jet:
    return _negate(_maximum(_negate(a), _negate(b)))


def _absolute(a: Jet) -> Jet:
    opposite = _negate(a)
    slope = interval.hull(a.slope, opposite.slope)
    return _choose(a.value.lower >= 0, a.value.upper <= 0, a, opposite, interval.absolute(a.value), slope)


def _where(condition: Truth, a: Jet, b: Jet) -> Jet:
    undecided = interval.whole(condition.certain.shape)
    return _choose(condition.certain, ~condition.possible, a, b, interval.hull(a.value, b.value), undecided)


def _step(lower: Floats, upper: Floats) -> Jet:
    """A function that is constant between jumps, with the values ``lower`` and ``upper`` at the ends."""
    zero, unknown = interval.full(0.0, lower.shape), interval.whole(lower.shape)
    flat = lower == upper
    return Jet(Interval(lower, upper), interval.select(flat, zero, unknown), interval.select(flat, zero, unknown))


def _compare(op: str, a: Interval, b: Interval) -> Truth:
    if op == "less":
        return Truth(a.upper < b.lower, a.lower < b.upper)
    if op == "less_equal":
        return Truth(a.upper <= b.lower, a.lower <= b.upper)
    same_point = (a.lower == a.upper) & (b.lower == b.upper) & (a.lower == b.lower)
    return Truth(same_point, (a.lower <= b.upper) & (b.lower <= a.upper))


def _logic(op: str, arguments: list[Truth]) -> Truth:
    first = arguments[0]
    if op == "not":
        return Truth(~first.possible, ~first.certain)
    second = arguments[1]
    if op == "and":
        return Truth(first.certain & second.certain, first.possible & second.possible)
    return Truth(first.certain | second.certain, first.possible | second.possible)


ARITHMETIC: dict[str, Callable[..., Jet]] = {
    "add": _add,
    "subtract": _subtract,
    "multiply": _multiply,
    "divide": _divide,
    "reciprocal": _reciprocal,
    "negate": _negate,
    "maximum": _maximum,
    "minimum": _minimum,
    "abs": _absolute,
    "sign": lambda a: _step(np.sign(a.value.lower), np.sign(a.value.upper)),
    "floor": lambda a: _step(np.floor(a.value.lower), np.floor(a.value.upper)),
    "ceil": lambda a: _step(np.ceil(a.value.lower), np.ceil(a.value.upper)),
    "round": lambda a: _step(np.rint(a.value.lower), np.rint(a.value.upper)),
}
