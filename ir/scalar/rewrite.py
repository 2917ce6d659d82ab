"""Equivalent forms of scalar expressions: constants folded, exponentials recognised as sigmoid and softplus.

Every rule is an identity over the real numbers. They matter for stability (``log(1 + exp(x))`` overflows) and for tight
enclosures (``x * x`` is never negative).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from mn_onnx.ir.expression import Expression, apply, constant
from mn_onnx.ir.scalar.functions import FUNCTIONS

# The defaults of ONNX's Clip: a bound of this size means "no bound".
NO_BOUND = float(np.finfo(np.float32).max)


def _is_constant(expression: Expression, value: float) -> bool:
    return expression.op == "constant" and expression.value == value


def _pairs(expression: Expression) -> tuple[tuple[Expression, Expression], ...]:
    """Both orders of the arguments of a commutative operation."""
    a, b = expression.arguments
    return ((a, b), (b, a))


def _opposite(expression: Expression) -> Expression:
    if expression.op == "negate":
        return expression.arguments[0]
    if expression.op == "constant":
        return constant(-expression.value)
    if expression.op == "multiply":
        for factor, other in _pairs(expression):
            if factor.op == "constant":
                return apply("multiply", constant(-factor.value), other)
    return apply("negate", expression)


def _one_plus_exp(expression: Expression) -> Expression | None:
    """``x`` if ``expression`` is ``1 + exp(x)``."""
    if expression.op == "add":
        for one, other in _pairs(expression):
            if _is_constant(one, 1.0) and other.op == "exp":
                return other.arguments[0]
    return None


def _rewrite_add(expression: Expression) -> Expression:
    for term, other in _pairs(expression):
        if _is_constant(term, 0.0):
            return other
        # max(x, 0) + softplus(-|x|) is how log(1 + exp(x)) is written to avoid overflow.
        if term.op == "maximum" and other.op == "softplus":
            for zero, x in _pairs(term):
                if _is_constant(zero, 0.0) and other.arguments[0] == apply("negate", apply("abs", x)):
                    return apply("softplus", x)
    return expression


def _rewrite_subtract(expression: Expression) -> Expression:
    a, b = expression.arguments
    if _is_constant(b, 0.0):
        return a
    if _is_constant(a, 0.0):
        return apply("negate", b)
    return expression


def _rewrite_multiply(expression: Expression) -> Expression:
    a, b = expression.arguments
    if a == b:
        return apply("power", a, constant(2.0))
    for factor, other in _pairs(expression):
        if _is_constant(factor, 1.0):
            return other
        if _is_constant(factor, -1.0):
            return _opposite(other)
    return expression


def _rewrite_divide(expression: Expression) -> Expression:
    a, b = expression.arguments
    if _is_constant(b, 1.0):
        return a
    if _is_constant(a, 1.0):
        return _rewrite_reciprocal(apply("reciprocal", b))
    # The logistic function in terms of the growing exponential.
    if a.op == "exp" and _one_plus_exp(b) == a.arguments[0]:
        return apply("sigmoid", a.arguments[0])
    return expression


def _rewrite_reciprocal(expression: Expression) -> Expression:
    exponent = _one_plus_exp(expression.arguments[0])
    return expression if exponent is None else apply("sigmoid", _opposite(exponent))


def _rewrite_log(expression: Expression) -> Expression:
    (argument,) = expression.arguments
    exponent = _one_plus_exp(argument)
    if exponent is not None:
        return apply("softplus", exponent)
    if argument.op == "exp":
        return argument.arguments[0]
    if argument.op == "sigmoid":
        return _opposite(apply("softplus", _opposite(argument.arguments[0])))
    return expression


def _rewrite_sqrt(expression: Expression) -> Expression:
    (argument,) = expression.arguments
    if argument.op == "power" and _is_constant(argument.arguments[1], 2.0):
        return apply("abs", argument.arguments[0])
    return expression


def _rewrite_power(expression: Expression) -> Expression:
    base, exponent = expression.arguments
    if _is_constant(exponent, 1.0):
        return base
    if _is_constant(exponent, 0.5):
        return _rewrite_sqrt(apply("sqrt", base))
    if _is_constant(exponent, -1.0):
        return _rewrite_reciprocal(apply("reciprocal", base))
    return expression


def _rewrite_extremum(expression: Expression, unbounded: float) -> Expression:
    a, b = expression.arguments
    if a == b:
        return a
    for bound, other in _pairs(expression):
        if bound.op == "constant" and bound.value * unbounded >= NO_BOUND:
            return other
    return expression


def _rewrite_negate(expression: Expression) -> Expression:
    return _opposite(expression.arguments[0])


def _rewrite_where(expression: Expression) -> Expression:
    condition, a, b = expression.arguments
    if a == b:
        return a
    if condition.op == "constant":
        return a if condition.value else b
    return expression


RULES: dict[str, Callable[[Expression], Expression]] = {
    "add": _rewrite_add,
    "subtract": _rewrite_subtract,
    "multiply": _rewrite_multiply,
    "divide": _rewrite_divide,
    "reciprocal": _rewrite_reciprocal,
    "log": _rewrite_log,
    "sqrt": _rewrite_sqrt,
    "power": _rewrite_power,
    "maximum": functools.partial(_rewrite_extremum, unbounded=-1.0),
    "minimum": functools.partial(_rewrite_extremum, unbounded=1.0),
    "negate": _rewrite_negate,
    "where": _rewrite_where,
}


def _fold(expression: Expression) -> Expression:
    """The value of an operation on constants, if it is finite."""
    with np.errstate(all="ignore"):
        value = float(FUNCTIONS[expression.op](*(np.array(argument.value) for argument in expression.arguments)))
    return constant(value) if math.isfinite(value) else expression


@functools.lru_cache(maxsize=4096)
def rewrite(expression: Expression) -> Expression:
    """``expression`` in its stable form."""
    if not expression.arguments:
        return expression
    result = Expression(expression.op, tuple(rewrite(argument) for argument in expression.arguments))
    if all(argument.op == "constant" for argument in result.arguments):
        return _fold(result)
    return RULES[result.op](result) if result.op in RULES else result
