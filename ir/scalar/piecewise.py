"""Exact arithmetic with piecewise polynomials of one variable over the rationals.

A double is a rational number, so whether an expression such as ``x * sign(x)`` or a nest of ``where``, ``max`` and
``min`` is piecewise linear and continuous can be decided exactly, without a tolerance.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.scalar.functions import FUNCTIONS

# Products beyond this degree never come back to degree one in practice.
HIGHEST_DEGREE = 4
MOST_KNOTS = 4096

Polynomial = tuple[Fraction, ...]


class NotPiecewisePolynomial(Exception):
    """The expression is no piecewise polynomial that this arithmetic can represent."""


@dataclass(frozen=True)
class Piecewise:
    """``pieces[i]`` holds strictly between knots ``i - 1`` and ``i``, ``values[i]`` at knot ``i``.

    Pieces are polynomials (coefficients from the constant term up, no trailing zero) with `Fraction` values, or truth
    values throughout.
    """

    knots: tuple[Fraction, ...]
    pieces: tuple[Any, ...]
    values: tuple[Any, ...]


def _trim(coefficients: list[Fraction]) -> Polynomial:
    while coefficients and not coefficients[-1]:
        coefficients.pop()
    return tuple(coefficients)


def value_at(polynomial: Polynomial, t: Fraction) -> Fraction:
    """The polynomial at ``t``, by Horner's rule."""
    result = Fraction(0)
    for coefficient in reversed(polynomial):
        result = result * t + coefficient
    return result


def _add(a: Polynomial, b: Polynomial) -> Polynomial:
    length = max(len(a), len(b))
    padded = [tuple(p) + (Fraction(0),) * (length - len(p)) for p in (a, b)]
    return _trim([x + y for x, y in zip(*padded, strict=True)])


def _scale(a: Polynomial, factor: Fraction) -> Polynomial:
    return _trim([factor * coefficient for coefficient in a])


def _multiply(a: Polynomial, b: Polynomial) -> Polynomial:
    if not a or not b:
        return ()
    if len(a) + len(b) - 2 > HIGHEST_DEGREE:
        raise NotPiecewisePolynomial
    product = [Fraction(0)] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            product[i + j] += x * y
    return _trim(product)


def _constant_value(a: Polynomial) -> Fraction:
    if len(a) > 1:
        raise NotPiecewisePolynomial
    return a[0] if a else Fraction(0)


def _divide(a: Polynomial, b: Polynomial) -> Polynomial:
    divisor = _constant_value(b)
    if not divisor:
        raise NotPiecewisePolynomial
    return _scale(a, 1 / divisor)


def _restrict(function: Piecewise, knots: tuple[Fraction, ...]) -> Piecewise:
    """The same function with further ``knots`` (a sorted superset of its own)."""
    if knots == function.knots:
        return function
    position = [bisect_left(function.knots, knot) for knot in knots]
    values = []
    for knot, index in zip(knots, position, strict=True):
        if index < len(function.knots) and function.knots[index] == knot:
            values.append(function.values[index])
        else:
            piece = function.pieces[index]
            values.append(piece if isinstance(piece, bool) else value_at(piece, knot))
    # The piece left of a knot is the piece at its left insertion point; after the last knot comes the last piece.
    pieces = [function.pieces[index] for index in position] + [function.pieces[-1]]
    return Piecewise(knots, tuple(pieces), tuple(values))


def _combine(on_pieces: Callable[..., Any], on_values: Callable[..., Any], *functions: Piecewise) -> Piecewise:
    knots = tuple(sorted(set().union(*(function.knots for function in functions))))
    if len(knots) > MOST_KNOTS:
        raise NotPiecewisePolynomial
    common = [_restrict(function, knots) for function in functions]
    pieces = tuple(on_pieces(*parts) for parts in zip(*(function.pieces for function in common), strict=True))
    values = tuple(on_values(*parts) for parts in zip(*(function.values for function in common), strict=True))
    return _drop_idle_knots(Piecewise(knots, pieces, values))


def _drop_idle_knots(function: Piecewise) -> Piecewise:
    knots, pieces, values = [], [function.pieces[0]], []
    for knot, piece, value in zip(function.knots, function.pieces[1:], function.values, strict=True):
        left = pieces[-1]
        if piece == left and value == (left if isinstance(left, bool) else value_at(left, knot)):
            continue
        knots.append(knot)
        pieces.append(piece)
        values.append(value)
    return Piecewise(tuple(knots), tuple(pieces), tuple(values))


def _sign(number: Fraction) -> int:
    return (number > 0) - (number < 0)


def _signs(function: Piecewise) -> Piecewise:
    """The sign as a piecewise constant function; its knots are the roots and the jumps across zero."""
    edges: list[Fraction | None] = [None, *function.knots, None]
    roots = set(function.knots)
    for left, right, piece in zip(edges, edges[1:], function.pieces, strict=False):
        if len(piece) > 2:
            raise NotPiecewisePolynomial
        if len(piece) == 2:
            root = -piece[0] / piece[1]
            if (left is None or left < root) and (right is None or root < right):
                roots.add(root)
    knots = tuple(sorted(roots))
    refined = _restrict(function, knots)
    bounds: list[Fraction | None] = [None, *knots, None]
    signs = []
    for left, right, piece in zip(bounds, bounds[1:], refined.pieces, strict=False):
        if left is None:
            inside = Fraction(0) if right is None else right - 1
        else:
            inside = left + 1 if right is None else (left + right) / 2
        signs.append(_sign(value_at(piece, inside)))
    return Piecewise(
        knots,
        tuple((Fraction(sign),) if sign else () for sign in signs),
        tuple(Fraction(_sign(value)) for value in refined.values),
    )


def _subtract(a: Piecewise, b: Piecewise) -> Piecewise:
    return _combine(lambda p, q: _add(p, _scale(q, Fraction(-1))), lambda x, y: x - y, a, b)


def _compare(a: Piecewise, b: Piecewise, holds: Callable[[Fraction], bool]) -> Piecewise:
    signs = _signs(_subtract(a, b))
    return _combine(lambda piece: holds(_constant_value(piece)), holds, signs)


def _choose(condition: Piecewise, a: Piecewise, b: Piecewise) -> Piecewise:
    def pick(c: bool, x: Any, y: Any) -> Any:
        return x if c else y

    return _combine(pick, pick, condition, a, b)


def _power(a: Piecewise, b: Piecewise) -> Piecewise:
    if b.knots:
        raise NotPiecewisePolynomial
    exponent = _constant_value(b.pieces[0])
    if exponent.denominator != 1 or not 0 <= exponent <= HIGHEST_DEGREE:
        return _apply_to_constants("power", a, b)
    result = Piecewise((), ((Fraction(1),),), ())
    for _ in range(int(exponent)):
        result = _combine(_multiply, lambda x, y: x * y, result, a)
    return result


def _apply_to_constants(op: str, *functions: Piecewise) -> Piecewise:
    """Any operation on piecewise constant functions, by its float64 values."""

    def on_values(*numbers: Fraction) -> Fraction:
        with np.errstate(all="ignore"):
            result = float(FUNCTIONS[op](*(np.array(float(number)) for number in numbers)))
        if not math.isfinite(result):
            raise NotPiecewisePolynomial
        return Fraction(result)

    return _combine(
        lambda *pieces: _trim([on_values(*(_constant_value(piece) for piece in pieces))]), on_values, *functions
    )


def _divide_functions(a: Piecewise, b: Piecewise) -> Piecewise:
    def on_values(x: Fraction, y: Fraction) -> Fraction:
        if not y:
            raise NotPiecewisePolynomial
        return x / y

    return _combine(_divide, on_values, a, b)


def _both(a: Any, b: Any) -> bool:
    return bool(a) and bool(b)


def _either(a: Any, b: Any) -> bool:
    return bool(a) or bool(b)


OPERATIONS: dict[str, Callable[..., Piecewise]] = {
    "add": lambda a, b: _combine(_add, lambda x, y: x + y, a, b),
    "subtract": _subtract,
    "multiply": lambda a, b: _combine(_multiply, lambda x, y: x * y, a, b),
    "divide": _divide_functions,
    "reciprocal": lambda a: _divide_functions(Piecewise((), ((Fraction(1),),), ()), a),
    "power": _power,
    "negate": lambda a: _combine(lambda p: _scale(p, Fraction(-1)), lambda x: -x, a),
    "abs": lambda a: _combine(_multiply, lambda x, y: x * y, a, _signs(a)),
    "sign": lambda a: _combine(lambda p: p, lambda x: x, _signs(a)),
    "maximum": lambda a, b: _choose(_compare(a, b, lambda sign: sign >= 0), a, b),
    "minimum": lambda a, b: _choose(_compare(a, b, lambda sign: sign <= 0), a, b),
    "less": lambda a, b: _compare(a, b, lambda sign: sign < 0),
    "less_equal": lambda a, b: _compare(a, b, lambda sign: sign <= 0),
    "equal": lambda a, b: _compare(a, b, lambda sign: sign == 0),
    "and": lambda a, b: _combine(_both, _both, a, b),
    "or": lambda a, b: _combine(_either, _either, a, b),
    "not": lambda a: _combine(lambda x: not x, lambda x: not x, a),
    "where": _choose,
}


def piecewise(expression: Expression) -> Piecewise:
    """``expression`` as a piecewise polynomial, exactly.

    Raises `NotPiecewisePolynomial` if it is none, or has poles, or needs roots of polynomials beyond degree one.
    """
    if expression.op == "t":
        return Piecewise((), ((Fraction(0), Fraction(1)),), ())
    if expression.op == "constant":
        if not math.isfinite(expression.value):
            raise NotPiecewisePolynomial
        return Piecewise((), (_trim([Fraction(expression.value)]),), ())
    arguments = [piecewise(argument) for argument in expression.arguments]
    if expression.op in OPERATIONS:
        return OPERATIONS[expression.op](*arguments)
    return _apply_to_constants(expression.op, *arguments)
