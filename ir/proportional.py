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
    """The rows of ``weights`` (float64 [r, c]) grouped by direction, sign ignored.

    Groups are in the order of their first rows, and so are the members. Rows that are nearly but not exactly
    proportional stay apart, and so do rows of zeros, which have no direction.
    """
    is_zero = ~weights.any(axis=1)
    if is_zero.any():
        directed = np.flatnonzero(~is_zero)
        groups = [directed[group].tolist() for group in proportional_groups(weights[directed])] if directed.size else []
        return sorted([*groups, *([row] for row in np.flatnonzero(is_zero).tolist())])
    rows = weights.shape[0]
    normalised = weights / weights[np.arange(rows), pivots(weights)][:, None]
    # Equal rows have equal projections, so only neighbours in their order need to be compared.
    direction = np.cos(1.0 + np.arange(weights.shape[1]) ** 2)
    projection = normalised @ direction
    order = np.argsort(projection, kind="stable")
    slack = 4 * weights.shape[1] * TOLERANCE
    found: list[list[int]] = []
    for run in np.split(order, np.flatnonzero(np.diff(projection[order]) > slack) + 1):
        found.extend(_split_run(normalised, sorted(run.tolist())))
    return sorted(found)


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
