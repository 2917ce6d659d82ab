"""Where in its intervals a surrogate is above the function and where below: the deviation with its sign.

Errors of many units have different signs, and cancel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats, KnotTable, ScalarFunction
from mn_onnx.ir.scalar.deviation import deviation

PARTS = 8
"""Cells in each interval of a deviation profile, shorter towards the knots, where tails begin."""

MOST_CELLS = 2048
"""Of a profile; tables of many intervals, as of encodings, have fewer parts in each."""


class DeviationProfile(NamedTuple):
    """One output of a table in cells: its line and the signed deviation of the true function, float64 [cells] each.

    A cell lasts until the next one starts; the first starts at minus infinity. In it the table is
    ``slopes * t + intercepts``, and the true function lies above that by ``lowest`` to ``highest``.
    """

    starts: Floats
    slopes: Floats
    intercepts: Floats
    lowest: Floats
    highest: Floats


def deviation_profile(
    function: ScalarFunction, table: KnotTable, output: int, lower: float, upper: float
) -> DeviationProfile:
    """How ``function`` leaves output ``output`` of ``table``, proved on ``[lower, upper]``."""
    starts = np.concatenate([[-np.inf], table.knots])
    slopes, intercepts, errors = table.slopes[output], table.intercepts[output], table.errors[output]
    first, last = np.searchsorted(table.knots, [lower, upper], side="right")
    parts = min(PARTS, MOST_CELLS // int(last - first + 1))
    if not isinstance(function, Expression) or not errors.any() or not upper > lower or parts < 2:
        return DeviationProfile(starts, slopes, intercepts, -errors, errors)
    nodes = np.concatenate([[lower], table.knots[first:last], [upper]])
    steps = 0.5 - 0.5 * np.cos(np.pi * np.arange(parts) / parts)
    inner = (nodes[:-1, None] + np.diff(nodes)[:, None] * steps).ravel()
    interval = np.repeat(np.arange(first, last + 1), parts)
    ends = np.append(inner[1:], upper)
    sure, _ = deviation(function, inner, ends, slopes[interval], intercepts[interval])
    inner[0] = -np.inf
    return DeviationProfile(inner, slopes[interval], intercepts[interval], sure.lower, sure.upper)
