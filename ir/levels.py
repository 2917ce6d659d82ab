"""The units of a network as dense blocks, one per level: the form that evaluation, bounds and passes compute with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.network import AffineRow, Floats, Integers, Network


@dataclass(frozen=True, eq=False)
class LevelBlock:
    """All units that stand at one level: pre-activations ``v[columns] @ weights.T + bias``.

    ``units``: int64 [u]; ``columns``: int64 [c], increasing: the variables any of them reads; ``weights``: float64
    [u, c]; ``bias``: float64 [u]. ``outputs``: int64 [o]: the variables the units give, unit by unit;
    ``owner``: int64 [o]: the position in ``units`` of each.
    """

    units: Integers
    columns: Integers
    weights: Floats
    bias: Floats
    outputs: Integers
    owner: Integers

    def sum_outputs(self, of_outputs: Floats) -> Floats:
        """Sums over the outputs of each unit: [n, o] to [n, u]."""
        if self.outputs.size == self.units.size:
            return of_outputs
        starts = np.searchsorted(self.owner, np.arange(self.units.size))
        totals: Floats = np.add.reduceat(of_outputs, starts, axis=1)
        return totals


def dense_rows(rows: Sequence[AffineRow], columns: Integers) -> Floats:
    """The weights of ``rows`` over ``columns`` (a sorted superset of theirs), float64 [rows, columns]."""
    weights = np.zeros((len(rows), columns.size))
    for target, row in zip(weights, rows, strict=True):
        target[np.searchsorted(columns, row.columns)] = row.weights
    return weights


def used_columns(rows: Sequence[AffineRow]) -> Integers:
    """The variables that any of ``rows`` reads, increasing."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(row.columns for row in rows)]))


def level_blocks(network: Network) -> tuple[LevelBlock, ...]:
    """The levels of ``network`` from the inputs up."""
    level = network.unit_level
    order = np.argsort(level, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(level[order])) + 1) if order.size else []
    return tuple(_block(network, units) for units in groups)


def _block(network: Network, units: Integers) -> LevelBlock:
    rows = [network.units[index].row for index in units]
    columns = used_columns(rows)
    counts = np.array([network.units[index].n_outputs for index in units])
    owner = np.repeat(np.arange(units.size), counts)
    first = network.first_variable[units]
    outputs = first[owner] + np.arange(owner.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return LevelBlock(
        units, columns, dense_rows(rows, columns), np.array([row.bias for row in rows], np.float64), outputs, owner
    )


def contiguous(columns: Integers) -> slice | Integers:
    """``columns`` as a slice where they are consecutive, so that indexing gives a view."""
    if columns.size and (np.diff(columns) == 1).all():
        return slice(int(columns[0]), int(columns[-1]) + 1)
    return columns


def affine_row(columns: Integers, weights: Floats, bias: float) -> AffineRow:
    """A row without its zero weights."""
    kept = np.flatnonzero(weights)
    return AffineRow(columns[kept], weights[kept], float(bias))
