"""Derivatives of scalar expressions as expressions."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.scalar.rewrite import rewrite

ZERO, ONE, TWO = constant(0.0), constant(1.0), constant(2.0)


def _reciprocal_root(x: Expression) -> Expression:
    return apply("reciprocal", apply("sqrt", x))


def _square(x: Expression) -> Expression:
    return apply("power", x, TWO)


def _one_minus_square(x: Expression) -> Expression:
    return apply("multiply", apply("subtract", ONE, x), apply("add", ONE, x))


def _gaussian(x: Expression) -> Expression:
    return apply("multiply", constant(2 / math.sqrt(math.pi)), apply("exp", apply("negate", _square(x))))


# The derivative of each function of one argument, as a function of that argument.
OUTER: dict[str, Callable[[Expression], Expression]] = {
    "exp": lambda x: apply("exp", x),
    "log": lambda x: apply("reciprocal", x),
    "sqrt": lambda x: apply("multiply", constant(0.5), _reciprocal_root(x)),
    "reciprocal": lambda x: apply("negate", apply("power", x, constant(-2.0))),
    "sin": lambda x: apply("cos", x),
    "cos": lambda x: apply("negate", apply("sin", x)),
    "tan": lambda x: apply("add", ONE, _square(apply("tan", x))),
    "asin": lambda x: _reciprocal_root(_one_minus_square(x)),
    "acos": lambda x: apply("negate", _reciprocal_root(_one_minus_square(x))),
    "atan": lambda x: apply("reciprocal", apply("add", ONE, _square(x))),
    "sinh": lambda x: apply("cosh", x),
    "cosh": lambda x: apply("sinh", x),
    "tanh": lambda x: _one_minus_square(apply("tanh", x)),
    "asinh": lambda x: _reciprocal_root(apply("add", ONE, _square(x))),
    "acosh": lambda x: _reciprocal_root(apply("subtract", _square(x), ONE)),
    "atanh": lambda x: apply("reciprocal", _one_minus_square(x)),
    "sigmoid": lambda x: apply("multiply", apply("sigmoid", x), apply("sigmoid", apply("negate", x))),
    "softplus": lambda x: apply("sigmoid", x),
    "erf": _gaussian,
    "negate": lambda _: constant(-1.0),
    "abs": lambda x: apply("where", apply("less", x, ZERO), constant(-1.0), ONE),
}
STEPS = ("sign", "floor", "ceil", "round")


@functools.lru_cache(maxsize=4096)
def derivative(expression: Expression) -> Expression:
    """``d expression / dt``; at a kink the derivative on the side whose form holds at the kink itself."""
    return rewrite(_derivative(rewrite(expression)))


def _times(a: Expression, b: Expression) -> Expression:
    if ZERO in (a, b):
        return ZERO
    for factor, other in ((a, b), (b, a)):
        # Where the derivative inside is zero, that outside may be infinite.
        if other.op == "where" and ZERO in other.arguments[1:]:
            condition, *branches = other.arguments
            return apply("where", condition, *(_times(factor, branch) for branch in branches))
    return apply("multiply", a, b)


def _derivative(expression: Expression) -> Expression:
    if expression == T:
        return ONE
    if expression.op == "constant" or expression.op in STEPS:
        return ZERO
    if expression.op == "where":
        condition, a, b = expression.arguments
        return apply("where", condition, _derivative(a), _derivative(b))
    if len(expression.arguments) == 1:
        (argument,) = expression.arguments
        return _times(OUTER[expression.op](argument), _derivative(argument))
    a, b = expression.arguments
    slope_a, slope_b = _derivative(a), _derivative(b)
    match expression.op:
        case "add" | "subtract":
            return apply(expression.op, slope_a, slope_b)
        case "multiply":
            return apply("add", _times(slope_a, b), _times(a, slope_b))
        case "divide":
            numerator = apply("subtract", slope_a, _times(expression, slope_b))
            return apply("divide", numerator, b)
        case "power":
            exponent = b.value
            return _times(_times(b, apply("power", a, constant(exponent - 1.0))), slope_a)
        case "maximum":
            return apply("where", apply("less", a, b), slope_b, slope_a)
        case "minimum":
            return apply("where", apply("less", b, a), slope_b, slope_a)
    raise ValueError(f"the truth value {expression.op!r} has no derivative")
