"""Evaluation of scalar expressions in float64."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar.functions import FUNCTIONS
from mn_onnx.ir.scalar.rewrite import rewrite


def evaluate(expression: Expression, t: Floats) -> Floats:
    """``expression`` at ``t`` (float64, any shape), in the shape of ``t``.

    Forms that would overflow or cancel (softplus and sigmoid spelled with exponentials) are first replaced by stable
    ones. A branch of ``where`` that is not taken never reaches the result. Outside the domain of a function
    the value is NaN, at a pole infinite.
    """
    values = np.asarray(t, np.float64)
    with np.errstate(all="ignore"):
        result = _evaluate(rewrite(expression), values, {})
    return np.broadcast_to(np.asarray(result, np.float64), values.shape).copy()


def _evaluate(expression: Expression, t: Floats, known: dict[Expression, np.ndarray]) -> np.ndarray:
    if expression.op == "t":
        return t
    if expression.op == "constant":
        return np.float64(expression.value)  # type: ignore[return-value]
    if expression not in known:
        arguments = [_evaluate(argument, t, known) for argument in expression.arguments]
        known[expression] = FUNCTIONS[expression.op](*arguments)
    return known[expression]
