"""Enclosures of elementary functions with their first two derivatives over intervals.

Each function is monotone between known critical points, and so is each of its derivatives; the extreme values over an
interval are therefore among the values at its ends and at the critical points inside.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar import special
from mn_onnx.ir.scalar.interval import (
    Interval,
    add,
    clamp,
    full,
    multiply,
    outward_elementary,
    select,
    square,
    whole,
)

Elementwise = Callable[[Floats], Floats]
Enclosures = tuple[Interval, Interval, Interval]

# Beyond this argument a double cannot resolve the phase of a trigonometric function well enough to be of use.
LARGEST_PHASE = 1e9
ROOT_HALF = math.sqrt(0.5)
TWO_OVER_ROOT_PI = 2.0 / math.sqrt(math.pi)


@dataclass(frozen=True)
class Curve:
    """A function that is monotone between ``critical`` points, with values in ``[lowest, highest]``."""

    function: Elementwise
    critical: tuple[float, ...] = ()
    lowest: float = -math.inf
    highest: float = math.inf

    def over(self, x: Interval) -> Interval:
        """The range over ``x``; unbounded where the function is undefined."""
        at_lower, at_upper = self.function(x.lower), self.function(x.upper)
        lower, upper = np.minimum(at_lower, at_upper), np.maximum(at_lower, at_upper)
        for where in self.critical:
            slack = 4 * np.spacing(abs(where)) if where else 0.0
            inside = (x.lower <= where + slack) & (x.upper >= where - slack)
            if inside.any():
                value = float(self.function(np.array([where]))[0])
                lower = np.where(inside, np.minimum(lower, value), lower)
                upper = np.where(inside, np.maximum(upper, value), upper)
        return clamp(outward_elementary(lower, upper), self.lowest, self.highest)


def _gaussian(x: Floats) -> Floats:
    return TWO_OVER_ROOT_PI * np.exp(-np.square(np.clip(x, -1e3, 1e3)))


def _gaussian_slope(x: Floats) -> Floats:
    clipped = np.clip(x, -1e3, 1e3)
    return -2.0 * clipped * _gaussian(clipped)


def _sigmoid_slope(x: Floats) -> Floats:
    return 0.25 * special.sech_squared(0.5 * x)


def _sigmoid_curvature(x: Floats) -> Floats:
    return -_sigmoid_slope(x) * np.tanh(0.5 * x)


# f, f', f'' of each function; where a derivative has extrema, they are its critical points.
SMOOTH: dict[str, tuple[Curve, Curve, Curve]] = {
    "exp": (Curve(np.exp, lowest=0.0), Curve(np.exp, lowest=0.0), Curve(np.exp, lowest=0.0)),
    "tanh": (
        Curve(np.tanh, (), -1.0, 1.0),
        Curve(special.sech_squared, (0.0,), 0.0, 1.0),
        Curve(lambda x: -2.0 * np.tanh(x) * special.sech_squared(x), (-math.atanh(3**-0.5), math.atanh(3**-0.5))),
    ),
    "sigmoid": (
        Curve(special.sigmoid, (), 0.0, 1.0),
        Curve(_sigmoid_slope, (0.0,), 0.0, 0.25),
        Curve(_sigmoid_curvature, (-math.log(2 + 3**0.5), math.log(2 + 3**0.5))),
    ),
    "softplus": (
        Curve(special.softplus, (), 0.0),
        Curve(special.sigmoid, (), 0.0, 1.0),
        Curve(_sigmoid_slope, (0.0,), 0.0, 0.25),
    ),
    "erf": (
        Curve(special.erf, (), -1.0, 1.0),
        Curve(_gaussian, (0.0,), 0.0),
        Curve(_gaussian_slope, (-ROOT_HALF, ROOT_HALF)),
    ),
    "atan": (
        Curve(np.arctan),
        Curve(lambda x: 1.0 / (1.0 + np.square(x)), (0.0,), 0.0, 1.0),
        Curve(lambda x: -2.0 * np.clip(x, -1e150, 1e150) / np.square(1.0 + np.square(x)), (-(3**-0.5), 3**-0.5)),
    ),
    "asinh": (
        Curve(np.arcsinh),
        Curve(lambda x: 1.0 / np.hypot(1.0, x), (0.0,), 0.0, 1.0),
        Curve(lambda x: -np.clip(x, -1e150, 1e150) / np.hypot(1.0, x) ** 3, (-ROOT_HALF, ROOT_HALF)),
    ),
    "sinh": (Curve(np.sinh), Curve(np.cosh, (0.0,), 1.0), Curve(np.sinh)),
    "cosh": (Curve(np.cosh, (0.0,), 1.0), Curve(np.sinh), Curve(np.cosh, (0.0,), 1.0)),
    "asin": (
        Curve(np.arcsin),
        Curve(lambda x: 1.0 / np.sqrt((1.0 - x) * (1.0 + x)), (0.0,), 1.0),
        Curve(lambda x: x / ((1.0 - x) * (1.0 + x)) ** 1.5),
    ),
    "acos": (
        Curve(np.arccos),
        Curve(lambda x: -1.0 / np.sqrt((1.0 - x) * (1.0 + x)), (0.0,), -math.inf, -1.0),
        Curve(lambda x: -x / ((1.0 - x) * (1.0 + x)) ** 1.5),
    ),
    "atanh": (
        Curve(np.arctanh),
        Curve(lambda x: 1.0 / ((1.0 - x) * (1.0 + x)), (0.0,), 1.0),
        Curve(lambda x: 2.0 * x / ((1.0 - x) * (1.0 + x)) ** 2),
    ),
}

# Functions on half lines: (f, f', f''), each monotone there, and the lowest argument.
HALF_LINE: dict[str, tuple[tuple[Curve, Curve, Curve], float]] = {
    "log": (
        (Curve(np.log), Curve(lambda x: 1.0 / x, (), 0.0), Curve(lambda x: -1.0 / np.square(x), (), -math.inf, 0.0)),
        0.0,
    ),
    "sqrt": (
        (
            Curve(np.sqrt, (), 0.0),
            Curve(lambda x: 0.5 / np.sqrt(x), (), 0.0),
            Curve(lambda x: -0.25 / (x * np.sqrt(x)), (), -math.inf, 0.0),
        ),
        0.0,
    ),
    "acosh": (
        (
            Curve(np.arccosh, (), 0.0),
            Curve(lambda x: 1.0 / np.sqrt((x - 1.0) * (x + 1.0)), (), 0.0),
            Curve(lambda x: -x / ((x - 1.0) * (x + 1.0)) ** 1.5, (), -math.inf, 0.0),
        ),
        1.0,
    ),
}

# Rounding may push an argument this far below the lowest one that its exact value can take.
DOMAIN_SLACK = 1e-290


def enclose(op: str, x: Interval) -> Enclosures:
    """Enclosures of the function ``op`` and its first two derivatives over ``x``."""
    if op in SMOOTH:
        value, slope, curvature = SMOOTH[op]
        return value.over(x), slope.over(x), curvature.over(x)
    if op in HALF_LINE:
        return _enclose_half_line(op, x)
    if op == "tan":
        return _enclose_tangent(x)
    sine, cosine = _sine(x, 0.5 * math.pi, np.sin), _sine(x, 0.0, np.cos)
    if op == "sin":
        return sine, cosine, Interval(-sine.upper, -sine.lower)
    return cosine, Interval(-sine.upper, -sine.lower), Interval(-cosine.upper, -cosine.lower)


def _enclose_half_line(op: str, x: Interval) -> Enclosures:
    (value, slope, curvature), lowest = HALF_LINE[op]
    outside = x.lower < lowest - DOMAIN_SLACK
    inside = Interval(np.maximum(x.lower, lowest), np.maximum(x.upper, lowest))
    nothing = whole(x.lower.shape)
    first, second, third = (select(outside, nothing, curve.over(inside)) for curve in (value, slope, curvature))
    return first, second, third


def _has_multiple(x: Interval, slack: Floats, offset: float, period: float = 2 * math.pi) -> np.ndarray:
    """Whether ``offset + k * period`` lies in ``x`` for an integer k."""
    first = np.ceil((x.lower - slack - offset) / period)
    last = np.floor((x.upper + slack - offset) / period)
    has: np.ndarray = first <= last
    return has


def _sine(x: Interval, crest: float, function: Elementwise) -> Interval:
    """A sine whose maxima are at ``crest + 2 k pi``."""
    at_lower, at_upper = function(x.lower), function(x.upper)
    ends = clamp(outward_elementary(np.minimum(at_lower, at_upper), np.maximum(at_lower, at_upper)), -1.0, 1.0)
    slack = 1e-15 * (1.0 + x.magnitude)
    upper = np.where(_has_multiple(x, slack, crest), 1.0, ends.upper)
    lower = np.where(_has_multiple(x, slack, crest + math.pi), -1.0, ends.lower)
    far = ~(x.magnitude <= LARGEST_PHASE)
    return Interval(np.where(far, -1.0, lower), np.where(far, 1.0, upper))


def _enclose_tangent(x: Interval) -> Enclosures:
    slack = 1e-15 * (1.0 + x.magnitude)
    has_pole = _has_multiple(x, slack, 0.5 * math.pi, math.pi) | ~(x.magnitude <= LARGEST_PHASE)
    ends = outward_elementary(np.tan(x.lower), np.tan(x.upper))
    value = select(has_pole, whole(x.lower.shape), ends)
    slope = add(square(value), full(1.0, x.lower.shape))
    return value, slope, multiply(multiply(full(2.0, x.lower.shape), value), slope)
