"""Tables so close to their functions that they may stand for them, where bounds are wanted in small ranges."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, ScalarFunction
from mn_onnx.ir.scalar import UndefinedFunction
from mn_onnx.ir.surrogate.fit import fit

FINENESS = 1000.0
"""How many times smaller the error of the close table is, about, for some thirty times the knots."""


def close_table(function: ScalarFunction, table: KnotTable, output: int, lower: float, upper: float) -> KnotTable:
    """A table of ``function`` alone, which output ``output`` of ``table`` follows on ``[lower, upper]``.

    That output itself where it is exact, or where rounding forbids a smaller error.
    """
    own = slice(output, output + 1)
    itself = KnotTable(table.knots, table.slopes[own], table.intercepts[own], table.errors[own])
    error = float(itself.errors.max(initial=0.0))
    # A constant's error is the smallest number there is, of which there is no part.
    if not isinstance(function, Expression) or error / FINENESS == 0.0 or not upper > lower:
        return itself
    try:
        closer = fit((function,), lower, upper, (error / FINENESS,), most_excess=2.0)
    except UndefinedFunction:
        return itself
    return closer if np.isfinite(closer.errors).all() else itself
