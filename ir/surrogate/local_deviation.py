"""Where in its intervals a surrogate is above the function and where below: the deviation with its sign.

A finer table of the function, with a smaller proved error, says this: on a small part of an interval far more than the
interval's error bound does. Errors of many units have different signs there, and cancel.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, ScalarFunction
from mn_onnx.ir.scalar import UndefinedFunction
from mn_onnx.ir.surrogate.fit import fit

FINENESS = 96.0
"""How many times smaller the error of the finer table is, for about ten times the knots."""


def finer_table(function: ScalarFunction, table: KnotTable, output: int, lower: float, upper: float) -> KnotTable:
    """A table of ``function`` alone, which output ``output`` of ``table`` follows on ``[lower, upper]``.

    That output itself where it is exact, or where rounding forbids a smaller error.
    """
    own = slice(output, output + 1)
    itself = KnotTable(table.knots, table.slopes[own], table.intercepts[own], table.errors[own])
    error = float(itself.errors.max(initial=0.0))
    if not isinstance(function, Expression) or error == 0.0 or not upper > lower:
        return itself
    try:
        finer = fit((function,), lower, upper, (error / FINENESS,))
    except UndefinedFunction:
        return itself
    return finer if np.isfinite(finer.errors).all() else itself
