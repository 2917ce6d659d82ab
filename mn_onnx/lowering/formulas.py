"""Activations as scalar expressions, by their definitions in the ONNX operator specification."""

from __future__ import annotations

import math

import numpy as np

from mn_onnx.ir.expression import Expression, apply, constant

ZERO, ONE = constant(0.0), constant(1.0)


def add(*terms: Expression) -> Expression:
    """The sum of terms."""
    total = terms[0]
    for term in terms[1:]:
        total = apply("add", total, term)
    return total


def times(factor: float, x: Expression) -> Expression:
    """``factor * x``."""
    return x if factor == 1.0 else apply("multiply", constant(factor), x)


def positive_part(x: Expression) -> Expression:
    """``max(x, 0)``."""
    return apply("maximum", x, ZERO)


def negative_part(x: Expression) -> Expression:
    """``min(x, 0)``."""
    return apply("minimum", x, ZERO)


def leaky(x: Expression, slope: float) -> Expression:
    """``x`` above zero, ``slope * x`` below."""
    return positive_part(x) if slope == 0.0 else add(positive_part(x), times(slope, negative_part(x)))


def clip(x: Expression, lowest: float, highest: float) -> Expression:
    """Infinite bounds are left out. Where the bounds cross, the upper one holds, as in numpy."""
    if lowest != -math.inf:
        x = apply("maximum", x, constant(lowest))
    return x if highest == math.inf else apply("minimum", x, constant(highest))


def expm1_of_negative_part(x: Expression, rate: float) -> Expression:
    """``exp(min(x, 0) / rate) - 1``."""
    exponent = negative_part(x) if rate == 1.0 else apply("divide", negative_part(x), constant(rate))
    return apply("subtract", apply("exp", exponent), ONE)


def elu(x: Expression, alpha: float) -> Expression:
    """``x`` above zero, ``alpha (e^x - 1)`` below."""
    return add(positive_part(x), times(alpha, expm1_of_negative_part(x, 1.0)))


def selu(x: Expression, alpha: float, gamma: float) -> Expression:
    """``gamma`` times `elu`."""
    return times(gamma, elu(x, alpha))


def celu(x: Expression, alpha: float) -> Expression:
    """``x`` above zero, ``alpha (e^(x/alpha) - 1)`` below."""
    return add(positive_part(x), times(alpha, expm1_of_negative_part(x, alpha)))


def hard_sigmoid(x: Expression, alpha: float, beta: float) -> Expression:
    """``alpha x + beta`` between zero and one."""
    return clip(add(times(alpha, x), constant(beta)), 0.0, 1.0)


def hard_swish(x: Expression) -> Expression:
    """``x`` times `hard_sigmoid` with slope 1/6, an attribute in the specification and so a float32."""
    return apply("multiply", x, hard_sigmoid(x, float(np.float32(1.0 / 6.0)), 0.5))


def swish(x: Expression, rate: float) -> Expression:
    """``x sigmoid(rate x)``."""
    return apply("multiply", x, apply("sigmoid", times(rate, x)))


def mish(x: Expression) -> Expression:
    """``x tanh(softplus(x))``."""
    return apply("multiply", x, apply("tanh", apply("softplus", x)))


def softsign(x: Expression) -> Expression:
    """``x / (1 + |x|)``."""
    return apply("divide", x, add(ONE, apply("abs", x)))


def gelu(x: Expression) -> Expression:
    """``x/2 (1 + erf(x / sqrt 2))``."""
    return apply("multiply", times(0.5, x), add(ONE, apply("erf", times(math.sqrt(0.5), x))))


def gelu_tanh(x: Expression) -> Expression:
    """``x/2 (1 + tanh(sqrt(2/pi) (x + 0.044715 x^3)))``, which is ``x sigmoid`` of twice the argument."""
    inner = add(x, times(0.044715, apply("power", x, constant(3.0))))
    return apply("multiply", times(0.5, x), add(ONE, apply("tanh", times(math.sqrt(2.0 / math.pi), inner))))


def thresholded_relu(x: Expression, threshold: float) -> Expression:
    """``x`` above the threshold, else zero: a step unless it is zero."""
    if threshold == 0.0:
        return positive_part(x)
    return apply("where", apply("less", constant(threshold), x), x, ZERO)


def shrink(x: Expression, threshold: float, bias: float) -> Expression:
    """``x -+ bias`` beyond the threshold on either side, zero between: a step unless both are equal."""
    below = apply("where", apply("less", x, constant(-threshold)), add(x, constant(bias)), ZERO)
    return apply("where", apply("less", constant(threshold), x), apply("subtract", x, constant(bias)), below)


def truncate(x: Expression) -> Expression:
    """Rounding towards zero."""
    return apply("where", apply("less", x, ZERO), apply("ceil", x), apply("floor", x))


def remainder(x: Expression, y: Expression, like_c: bool) -> Expression:
    """``x mod y``: with the sign of ``x`` as in C, or else that of ``y``."""
    quotient = apply("divide", x, y)
    whole = truncate(quotient) if like_c else apply("floor", quotient)
    return apply("subtract", x, apply("multiply", y, whole))


def truth_as_number(condition: Expression) -> Expression:
    """One where the condition holds, else zero."""
    return apply("where", condition, ONE, ZERO)
