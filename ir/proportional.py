"""Groups of rows that are multiples of each other."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.network import Floats, Integers

# Rows count as proportional if their normalised weights agree to this: the rounding of a short chain of operations.
TOLERANCE = 64 * np.finfo(np.float64).eps


def pivots(weights: Floats) -> Integers:
    """Per row the first column whose weight is nearly the largest (stable under rounding), int64 [r]."""
    size = np.abs(weights)
    columns: Integers = np.argmax(size >= (1 - 1e-6) * size.max(axis=1, keepdims=True), axis=1)
    return columns


def proportional_groups(weights: Floats) -> list[list[int]]:
    """The rows of ``weights`` (float64 [r, c], none zero) grouped by direction, sign ignored.

    Groups are in the order of their first rows, and so are the members. Rows that are nearly but not exactly
    proportional stay apart.
    """
    rows = weights.shape[0]
    if not weights.size:
        return [[row] for row in range(rows)]
    normalised = weights / weights[np.arange(rows), pivots(weights)][:, None]
    # Equal rows have equal projections, so only neighbours in their order need to be compared.
    direction = np.cos(1.0 + np.arange(weights.shape[1]) ** 2)
    projection = normalised @ direction
    order = np.argsort(projection, kind="stable")
    slack = 4 * weights.shape[1] * TOLERANCE
    groups: list[list[int]] = []
    for run in np.split(order, np.flatnonzero(np.diff(projection[order]) > slack) + 1):
        groups.extend(_split_run(normalised, sorted(run.tolist())))
    return sorted(groups)


def _split_run(normalised: Floats, run: list[int]) -> list[list[int]]:
    groups: list[list[int]] = []
    for row in run:
        for group in groups:
            if np.abs(normalised[row] - normalised[group[0]]).max() <= TOLERANCE:
                group.append(row)
                break
        else:
            groups.append([row])
    return groups
