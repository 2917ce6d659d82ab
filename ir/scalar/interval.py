"""Interval arithmetic on arrays, rounded outward: every result encloses all values over its operands.

The four operations and the square root are correctly rounded (IEEE 754), so one step of ``nextafter`` is enough.
NumPy's elementary functions are accurate to 4 units in the last place (its own accuracy tests), so they get four.

Overflow and undefined ends are part of the arithmetic: callers switch NumPy's floating-point warnings off.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.network import Floats

ELEMENTARY_ULPS = 4
TINY = 16 * np.finfo(np.float64).tiny


@dataclass(frozen=True, eq=False)
class Interval:
    """``[lower, upper]``, elementwise; float64 arrays of one shape. Infinite ends mean "no bound known"."""

    lower: Floats
    upper: Floats

    def __getitem__(self, where: slice) -> Interval:
        return Interval(self.lower[where], self.upper[where])

    @property
    def magnitude(self) -> Floats:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    @property
    def width(self) -> Floats:
        return self.upper - self.lower

    @property
    def is_bounded(self) -> np.ndarray:
        return np.isfinite(self.lower) & np.isfinite(self.upper)


def point(value: Floats) -> Interval:
    """The interval of one number each."""
    return Interval(value, value)


def full(value: float, shape: tuple[int, ...]) -> Interval:
    """``[value, value]`` in ``shape``."""
    return point(np.full(shape, value))


def whole(shape: tuple[int, ...]) -> Interval:
    """All real numbers: nothing is known."""
    return Interval(np.full(shape, -np.inf), np.full(shape, np.inf))


def _unless_undefined(values: Floats, otherwise: float) -> Floats:
    undefined = np.isnan(values)
    return np.where(undefined, otherwise, values) if undefined.any() else values


def outward(lower: Floats, upper: Floats) -> Interval:
    """One rounding step outward; undefined ends (infinity minus infinity) become unbounded."""
    return Interval(
        np.nextafter(_unless_undefined(lower, -np.inf), -np.inf), np.nextafter(_unless_undefined(upper, np.inf), np.inf)
    )


def outward_elementary(lower: Floats, upper: Floats) -> Interval:
    """Outward by the error of an elementary function, and by a few of the smallest normal numbers (underflow)."""
    below = lower - (ELEMENTARY_ULPS * np.spacing(np.abs(lower)) + TINY)
    above = upper + (ELEMENTARY_ULPS * np.spacing(np.abs(upper)) + TINY)
    # The spacing of an infinite number is undefined; such an end stays as it is.
    return Interval(
        np.where(np.isnan(lower), -np.inf, np.where(np.isinf(lower), lower, below)),
        np.where(np.isnan(upper), np.inf, np.where(np.isinf(upper), upper, above)),
    )


def negate(a: Interval) -> Interval:
    """``-a``."""
    return Interval(-a.upper, -a.lower)


def add(a: Interval, b: Interval) -> Interval:
    """``a + b``."""
    return outward(a.lower + b.lower, a.upper + b.upper)


def subtract(a: Interval, b: Interval) -> Interval:
    """``a - b``."""
    return add(a, negate(b))


def _product(a: Floats, b: Floats) -> Floats:
    # Zero times an unbounded end is zero: the end stands for arbitrarily large but finite numbers.
    return _unless_undefined(a * b, 0.0)


def multiply(a: Interval, b: Interval) -> Interval:
    """``a * b``."""
    if b.lower is b.upper:
        a, b = b, a
    # Of a single number only two products need to be compared.
    corners = [_product(a.lower, b.lower), _product(a.lower, b.upper)]
    if a.lower is not a.upper:
        corners += [_product(a.upper, b.lower), _product(a.upper, b.upper)]
    lower, upper = functools.reduce(np.minimum, corners), functools.reduce(np.maximum, corners)
    result = outward(lower, upper)
    exact_zero = (lower == 0) & (upper == 0)
    if not exact_zero.any():
        return result
    return Interval(np.where(exact_zero, 0.0, result.lower), np.where(exact_zero, 0.0, result.upper))


def square(a: Interval) -> Interval:
    """``a * a`` as a function of one variable: never negative."""
    largest = a.magnitude
    smallest = np.where((a.lower <= 0) & (a.upper >= 0), 0.0, np.minimum(np.abs(a.lower), np.abs(a.upper)))
    result = outward(smallest * smallest, largest * largest)
    return Interval(np.maximum(result.lower, 0.0), result.upper)


def reciprocal(a: Interval) -> Interval:
    """``1 / a``; unbounded where ``a`` contains zero."""
    result = outward(1.0 / a.upper, 1.0 / a.lower)
    has_zero = (a.lower <= 0) & (a.upper >= 0)
    return Interval(np.where(has_zero, -np.inf, result.lower), np.where(has_zero, np.inf, result.upper))


def _non_negative_power(base: Floats, exponent: int) -> Interval:
    """``base ** exponent`` of numbers that are not negative, by squaring."""
    result, factor = full(1.0, base.shape), point(base)
    while exponent:
        if exponent % 2:
            result = multiply(result, factor)
        factor, exponent = square(factor), exponent // 2
    return result


def integer_power(a: Interval, exponent: int) -> Interval:
    """``a ** exponent`` for a non-negative integer exponent."""
    if exponent % 2 == 0:
        size = absolute(a)
        low, high = _non_negative_power(size.lower, exponent), _non_negative_power(size.upper, exponent)
        return Interval(np.maximum(low.lower, 0.0), high.upper)
    low, high = _non_negative_power(np.abs(a.lower), exponent), _non_negative_power(np.abs(a.upper), exponent)
    return Interval(np.where(a.lower < 0, -low.upper, low.lower), np.where(a.upper < 0, -high.lower, high.upper))


def absolute(a: Interval) -> Interval:
    """``|a|``."""
    smallest = np.where((a.lower <= 0) & (a.upper >= 0), 0.0, np.minimum(np.abs(a.lower), np.abs(a.upper)))
    return Interval(smallest, a.magnitude)


def hull(a: Interval, b: Interval) -> Interval:
    """The smallest interval that contains both."""
    return Interval(np.minimum(a.lower, b.lower), np.maximum(a.upper, b.upper))


def select(condition: np.ndarray, a: Interval, b: Interval) -> Interval:
    """``a`` where ``condition``, else ``b``."""
    return Interval(np.where(condition, a.lower, b.lower), np.where(condition, a.upper, b.upper))


def clamp(a: Interval, lowest: float, highest: float) -> Interval:
    """``a`` cut to the known range of a function."""
    return Interval(np.clip(a.lower, lowest, highest), np.clip(a.upper, lowest, highest))
