"""Running error analysis of scalar expressions: a bound on what rounding does to them in a given precision."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.expression import Expression, T
from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar.derivative import OUTER, STEPS
from mn_onnx.ir.scalar.evaluate import evaluate
from mn_onnx.ir.scalar.functions import FUNCTIONS

# Mathematical functions of runtimes are accurate to this many units in the last place.
FUNCTION_ULPS = 8
# ... of the value, or for these of 1: runtimes approximate them with an error that does not shrink with the value
# (onnxruntime's sigmoid is a rational function plus one half).
UNIT_SCALE = ("sigmoid", "tanh", "erf", "sin", "cos", "softplus")


def running_error(expression: Expression, t: Floats, t_error: Floats, unit_roundoff: float) -> tuple[Floats, Floats]:
    """(values, error bounds) of ``expression`` at ``t`` when ``t`` is off by ``t_error`` and every operation rounds.

    To first order in the errors (Higham, "Accuracy and Stability of Numerical Algorithms", section 3.3). The expression
    is taken operation by operation as it stands: that is how a runtime computes it.
    """
    with np.errstate(all="ignore"):
        value, error = _run(expression, np.asarray(t, np.float64), t_error, unit_roundoff)
    return np.broadcast_to(value, np.shape(t)), np.broadcast_to(error, np.shape(t))


def _run(expression: Expression, t: Floats, t_error: Floats, unit: float) -> tuple[Floats, Floats]:
    op = expression.op
    if op == "t":
        return t, t_error
    if op == "constant":
        return np.array(expression.value), np.array(unit * abs(expression.value))
    if op == "where":
        condition, a, b = expression.arguments
        holds = _run(condition, t, t_error, unit)[0]
        (value_a, error_a), (value_b, error_b) = _run(a, t, t_error, unit), _run(b, t, t_error, unit)
        # Near the threshold the other branch may be taken; branches meet there, so its error covers the difference.
        return np.where(holds, value_a, value_b), np.where(holds, error_a, error_b)
    parts = [_run(argument, t, t_error, unit) for argument in expression.arguments]
    values, errors = [part[0] for part in parts], [part[1] for part in parts]
    value = FUNCTIONS[op](*values)
    if op in ("less", "less_equal", "equal", "and", "or", "not", *STEPS):
        return value, np.zeros_like(errors[0])
    match op:
        case "add" | "subtract":
            passed = errors[0] + errors[1]
        case "multiply":
            passed = np.abs(values[0]) * errors[1] + np.abs(values[1]) * errors[0]
        case "divide":
            passed = (errors[0] + np.abs(value) * errors[1]) / np.abs(values[1])
        case "maximum" | "minimum":
            return value, np.maximum(errors[0], errors[1])
        case "power":
            exponent = expression.arguments[1].value
            passed = np.abs(exponent * values[0] ** (exponent - 1)) * errors[0]
        case _:
            passed = np.abs(evaluate(OUTER[op](T), values[0])) * errors[0]
    size = np.maximum(np.abs(value), 1.0) if op in UNIT_SCALE else np.abs(value)
    return value, passed + FUNCTION_ULPS * unit * size
