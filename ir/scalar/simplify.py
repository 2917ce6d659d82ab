"""Recognition of piecewise-linear expressions."""

from __future__ import annotations

import functools
from fractions import Fraction
from itertools import pairwise

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar.piecewise import NotPiecewisePolynomial, Piecewise, piecewise, value_at
from mn_onnx.ir.scalar.rewrite import rewrite


@functools.lru_cache(maxsize=4096)
def simplify(expression: Expression) -> KnotTable | Expression:
    """The one-output `KnotTable` that ``expression`` equals exactly, else the expression in its stable form.

    A table results if and only if the expression is continuous and piecewise linear and this can be decided with
    rational arithmetic on its float64 constants (affine thresholds; no roots of higher polynomials). Knots, slopes and
    intercepts are the exact ones rounded to float64 once, so values agree to a few units in the last place of the
    largest term.
    """
    stable = rewrite(expression)
    try:
        function = piecewise(stable)
    except NotPiecewisePolynomial:
        return stable
    table = _table(function)
    return stable if table is None else table


def _table(function: Piecewise) -> KnotTable | None:
    """The table of a continuous piecewise-linear function, None for any other."""
    if any(isinstance(piece, bool) or len(piece) > 2 for piece in function.pieces):
        return None
    for knot, (left, right), value in zip(function.knots, pairwise(function.pieces), function.values, strict=True):
        if not value_at(left, knot) == value == value_at(right, knot):
            return None
    knots: list[float] = []
    pieces = [function.pieces[0]]
    for exact_knot, piece in zip(function.knots, function.pieces[1:], strict=True):
        rounded = float(exact_knot)
        if knots and rounded == knots[-1]:
            # Two knots in one double: the piece between them is narrower than the rounding of t.
            pieces[-1] = piece
        else:
            knots.append(rounded)
            pieces.append(piece)
    coefficients = np.array([[float(c) for c in (*piece, Fraction(0), Fraction(0))[:2]] for piece in pieces])
    return KnotTable.exact(knots, [coefficients[:, 1].tolist()], [coefficients[:, 0].tolist()])
