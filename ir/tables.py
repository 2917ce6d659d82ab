"""Operations on knot tables: change of variable, sums, merging, inversion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mn_onnx.ir.network import Floats, Integers, KnotTable

# Knots of merged tables closer than this many units in the last place are one knot, computed in two ways.
SAME_KNOT_ULPS = 32


def substitute(table: KnotTable, scale: float, offset: float) -> KnotTable:
    """The table of ``s -> table(scale * s + offset)``, ``scale`` not zero."""
    knots = (table.knots - offset) / scale
    slopes, intercepts = table.slopes * scale, table.intercepts + table.slopes * offset
    if scale > 0:
        return KnotTable(knots, slopes, intercepts, table.errors)
    return KnotTable(
        knots[::-1].copy(), slopes[:, ::-1].copy(), intercepts[:, ::-1].copy(), table.errors[:, ::-1].copy()
    )


def interval_indices(table: KnotTable, knots: Floats) -> Integers:
    """int64 [knots + 1]: the interval of ``table`` that holds each interval of ``knots``, a superset of its knots."""
    return np.concatenate([np.zeros(1, np.int64), np.searchsorted(table.knots, knots, side="right")])


def merge(tables: Sequence[KnotTable], scale: float = 0.0) -> KnotTable:
    """One table with the outputs of all ``tables`` in order, over the union of their knots.

    Knots that differ by rounding become one; ``scale`` is the size of the numbers the knots were computed from.
    """
    knots = np.sort(np.concatenate([table.knots for table in tables]))
    if knots.size:
        slack = SAME_KNOT_ULPS * np.spacing(np.maximum(np.abs(knots), scale))
        knots = knots[np.concatenate([[True], np.diff(knots) > slack[1:]])]
    slopes, intercepts, errors = [], [], []
    for table in tables:
        # After snapping, a knot of the table is the merged knot at or just below it.
        snapped = knots[np.searchsorted(knots, table.knots, side="right") - 1] if table.knots.size else table.knots
        index = np.concatenate([np.zeros(1, np.int64), np.searchsorted(snapped, knots, side="right")])
        slopes.append(table.slopes[:, index])
        intercepts.append(table.intercepts[:, index])
        errors.append(table.errors[:, index])
    return KnotTable(knots, np.concatenate(slopes), np.concatenate(intercepts), np.concatenate(errors))


def combine(table: KnotTable, weights: Floats, bias: float) -> KnotTable:
    """The one-output table of ``bias + weights @ outputs``."""
    return KnotTable(
        table.knots,
        (weights @ table.slopes)[None, :],
        (weights @ table.intercepts + bias)[None, :],
        (np.abs(weights) @ table.errors)[None, :],
    )
