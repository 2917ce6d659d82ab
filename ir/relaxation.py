"""Linear relaxations of scalar functions: one slope and a range of offsets that enclose the function on an interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats, KnotTable, Unit
from mn_onnx.ir.scalar.deviation import deviation
from mn_onnx.ir.scalar.jet import jet


@dataclass(frozen=True, eq=False)
class Relaxation:
    """``slope * t + lower <= y <= slope * t + upper`` and ``least <= y <= greatest``; float64 [o], one per output."""

    slope: Floats
    lower: Floats
    upper: Floats
    least: Floats
    greatest: Floats


def empty_relaxation(n_outputs: int) -> Relaxation:
    """Room for ``n_outputs`` relaxations, to be filled in."""
    return Relaxation(*(np.empty(n_outputs) for _ in range(5)))


def relax_table(table: KnotTable, lower: float, upper: float) -> Relaxation:
    """All outputs of ``table`` on ``[lower, upper]``, widened by its errors: the true functions lie inside too."""
    first, last = np.searchsorted(table.knots, [lower, upper], side="right")
    nodes = np.concatenate([[lower], table.knots[first:last], [upper]])
    intervals = np.minimum(np.arange(first, first + nodes.size), last)
    values = table.slopes[:, intervals] * nodes + table.intercepts[:, intervals]
    error = table.errors[:, first : last + 1].max(axis=1)
    if first == last or not upper > lower:
        slope = table.slopes[:, first]
        offset = values - slope[:, None] * nodes
    else:
        slope = (values[:, -1] - values[:, 0]) / (upper - lower)
        offset = values - slope[:, None] * nodes
    return Relaxation(
        slope,
        offset.min(axis=1) - error,
        offset.max(axis=1) + error,
        values.min(axis=1) - error,
        values.max(axis=1) + error,
    )


def relax_expression(expression: Expression, lower: Floats, upper: Floats) -> Relaxation:
    """``expression`` on each of the intervals ``[lower, upper]`` (float64 [n]), [n] relaxations."""
    ends = jet(expression, np.concatenate([lower, upper]), np.concatenate([lower, upper])).value
    middle = 0.5 * (ends.lower + ends.upper)
    width = upper - lower
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.where(width > 0, (middle[lower.size :] - middle[: lower.size]) / width, 0.0)
    slope = np.where(np.isfinite(slope), slope, 0.0)
    zero = np.zeros(lower.size)
    offset, _ = deviation(expression, lower, upper, slope, zero)
    value, _ = deviation(expression, lower, upper, zero, zero)
    return Relaxation(slope, offset.lower, offset.upper, value.lower, value.upper)


def relax_units(units: list[Unit], lower: Floats, upper: Floats) -> Relaxation:
    """All outputs of ``units`` in order, over their pre-activations' ranges (float64 [u])."""
    result = empty_relaxation(sum(unit.n_outputs for unit in units))
    parts = (result.slope, result.lower, result.upper, result.least, result.greatest)
    pending: dict[Expression, tuple[list[int], list[int]]] = {}

    def store(where: slice | list[int], found: Relaxation) -> None:
        values = (found.slope, found.lower, found.upper, found.least, found.greatest)
        for target, value in zip(parts, values, strict=True):
            target[where] = value

    first = 0
    for index, unit in enumerate(units):
        stop = first + unit.n_outputs
        if unit.table is not None:
            store(slice(first, stop), relax_table(unit.table, lower[index], upper[index]))
        else:
            for output, function in zip(range(first, stop), unit.functions, strict=True):
                if isinstance(function, KnotTable):
                    store(slice(output, output + 1), relax_table(function, lower[index], upper[index]))
                else:
                    outputs, owners = pending.setdefault(function, ([], []))
                    outputs.append(output)
                    owners.append(index)
        first = stop
    for function, (outputs, owners) in pending.items():
        store(outputs, relax_expression(function, lower[owners], upper[owners]))
    return result
