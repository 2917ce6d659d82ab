"""From a canonical network to the flat arrays that the kernels read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.kernels.lanes import WIDE
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_END_F,
    CELL_END_I,
    CELL_FLOATS,
    CELL_HEADER,
    CELL_SYSTEM_F,
    CELL_SYSTEM_I,
    CELL_VERTICES,
    PIECE_FLOATS,
    SYS_COLS,
    SYS_FLOATS,
    SYS_HEADER,
    SYS_INTS,
    SYS_LEVELS,
    SYS_ROWS,
    SYS_SINGLE,
    SYS_UNITS,
    padded,
    system_floats,
    system_ints,
)
from mn_onnx.extract.kernels.records import Tables
from mn_onnx.ir.network import KnotTable, Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

DIMENSIONS = 3


class Packed(NamedTuple):
    """A network and box ready for traversal: tables, and the root system and cell as arena contents."""

    tables: Tables
    F: Floats
    N: Integers
    root: int
    rows: int
    cols: int
    levels: int


def pack(network: Network, lower: Floats, upper: Floats) -> Packed:
    """Pack a canonical network over the box ``lower``..``upper`` (float64 [3] each).

    Raises ``ValueError`` if a unit has no knot table or the box is not three-dimensional and of positive size.
    """
    lower = np.asarray(lower, np.float64)
    upper = np.asarray(upper, np.float64)
    if lower.shape != (DIMENSIONS,) or upper.shape != (DIMENSIONS,) or not np.all(lower < upper):
        raise ValueError(f"the box {lower.tolist()} .. {upper.tolist()} has no interior in three dimensions")
    for unit in network.units:
        if unit.table is None:
            raise ValueError(f"unit {unit.name} has no knot table; run the canonical passes first")
    order = np.argsort(network.unit_level, kind="stable")
    tables = _pack_tables(network, order, max(1.0, float(np.abs([lower, upper]).max())))
    system_f, system_i = _pack_system(network, order)
    cell_f, cell_i = _pack_box(lower, upper, network, order, system_f.size, system_i.size)
    return Packed(
        tables,
        np.concatenate([system_f, cell_f]),
        np.concatenate([system_i, cell_i]),
        system_i.size,
        int(system_i[SYS_ROWS]),
        int(system_i[SYS_COLS]),
        int(system_i[SYS_LEVELS]),
    )


def _pack_tables(network: Network, order: Integers, extent: float) -> Tables:
    tables = [unit.table for unit in (network.units[g] for g in order) if unit.table is not None]
    counts = np.array([table.knots.size for table in tables], np.int64)
    first_knot = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    pieces = np.array([table.slopes.size for table in tables], np.int64)
    first_piece = np.concatenate([np.zeros(1, np.int64), np.cumsum(pieces)])
    n_knots = int(first_knot[-1])
    # Seeded: keys must be the same in every run and on every worker.
    words = np.random.default_rng(0x6D6E2D6F6E6E78)
    limit = np.iinfo(np.int64)

    def draw(n: int) -> Integers:
        return words.integers(limit.min, limit.max, (n, 2), np.int64, endpoint=True)

    state_hash = draw(n_knots + len(tables))
    plane_hash = draw(n_knots + 2 * DIMENSIONS)
    tag_hash = np.repeat(plane_hash, 2, axis=0)
    unit_of_knot = np.repeat(np.arange(len(tables)), counts)
    below = np.arange(n_knots) + unit_of_knot
    tag_hash[0 : 2 * n_knots : 2] ^= state_hash[below]
    tag_hash[1 : 2 * n_knots : 2] ^= state_hash[below + 1]

    def join(parts: list[Floats]) -> Floats:
        return np.ascontiguousarray(np.concatenate([*parts, np.zeros(0)]), np.float64)

    return Tables(
        first_knot,
        join([table.knots for table in tables]),
        first_piece,
        join([table.slopes.reshape(-1) for table in tables]),
        join([table.intercepts.reshape(-1) for table in tables]),
        state_hash,
        tag_hash,
        n_knots,
        extent,
    )


def _two_pieces(table: KnotTable) -> Floats:
    """Knot, left slope and intercept, right slope and intercept of a unit with one knot and one output; else NaN."""
    if table.slopes.shape != (1, 2):
        return np.full(PIECE_FLOATS, np.nan)
    (left, right), (left_at, right_at) = table.slopes[0], table.intercepts[0]
    return np.array([table.knots[0], left, left_at, right, right_at])


def _pack_system(network: Network, order: Integers) -> tuple[Floats, Integers]:
    """The root system: all units, level by level, each level padded to the lane width."""
    levels = network.unit_level[order]
    starts = [0]
    row_of_unit = np.zeros(len(order), np.int64)
    for level in range(int(levels.max()) + 1 if levels.size else 0):
        members = order[levels == level]
        row_of_unit[members] = starts[-1] + np.arange(members.size)
        starts.append(-(-(starts[-1] + members.size) // WIDE) * WIDE)
    rows, n_levels = starts[-1], len(starts) - 1
    row_unit = np.full(rows, -1, np.int64)
    row_unit[row_of_unit[order]] = np.arange(order.size)
    outputs = np.zeros(rows, np.int64)
    outputs[row_of_unit[order]] = [network.units[g].n_outputs for g in order]
    row_col = np.concatenate([np.zeros(1, np.int64), np.cumsum(outputs)])
    cols = int(row_col[-1])
    col_row = np.repeat(np.arange(rows), outputs)

    # Variables are inputs, then outputs in unit order; columns are outputs in row order.
    col_of_variable = np.zeros(network.n_variables, np.int64)
    for g, unit in enumerate(network.units):
        first = network.first_variable[g]
        col_of_variable[first : first + unit.n_outputs] = row_col[row_of_unit[g]] + np.arange(unit.n_outputs)

    affine = np.zeros((4, rows))
    pieces = np.zeros((PIECE_FLOATS, rows))
    pieces[0] = np.inf
    weights = np.zeros((cols, rows))
    if network.units:
        affine[3, row_of_unit] = [unit.row.bias for unit in network.units]
        tables = {id(unit.table): unit.table for unit in network.units if unit.table is not None}
        pieces_of = {key: _two_pieces(table) for key, table in tables.items()}  # units of a layer share a table
        pieces[:, row_of_unit] = np.transpose([pieces_of[id(unit.table)] for unit in network.units])
        read = np.concatenate([unit.row.columns for unit in network.units])
        weight = np.concatenate([unit.row.weights for unit in network.units])
        row = np.repeat(row_of_unit, [unit.row.columns.size for unit in network.units])
        inside = read < network.input_dim
        affine[read[inside], row[inside]] = weight[inside]
        weights[col_of_variable[read[~inside]], row[~inside]] = weight[~inside]
    out_weights = np.zeros(padded(cols))
    out_affine = np.zeros(4)
    inside = network.output.columns < network.input_dim
    out_affine[network.output.columns[inside]] = network.output.weights[inside]
    out_affine[3] = network.output.bias
    out_weights[col_of_variable[network.output.columns[~inside]]] = network.output.weights[~inside]

    level_starts = np.array(starts, np.int64)
    level_of_column = np.searchsorted(level_starts, col_row, side="right") - 1
    begin = level_starts[1:][level_of_column]
    end = _extents(weights, level_starts, level_of_column)
    header = np.zeros(SYS_HEADER, np.int64)
    header[SYS_ROWS], header[SYS_COLS], header[SYS_LEVELS] = rows, cols, n_levels
    header[SYS_FLOATS], header[SYS_INTS] = system_floats(rows, cols), system_ints(rows, cols, n_levels)
    header[SYS_UNITS] = order.size
    header[SYS_SINGLE] = (outputs[row_of_unit] == 1).all()
    integers = np.concatenate([header, np.array(starts, np.int64), row_unit, row_col, col_row, begin, end])
    floats = np.concatenate([affine.reshape(-1), pieces.reshape(-1), weights.reshape(-1), out_weights, out_affine])
    assert (integers.size, floats.size) == (header[SYS_INTS], header[SYS_FLOATS])
    return floats, integers


def _extents(weights: Floats, level_starts: Integers, level_of_column: Integers) -> Integers:
    """Up to which row each column has weights: to the end of the last level that reads its level, or an earlier one."""
    used = weights != 0.0
    reads = np.logical_or.reduceat(used, level_starts[:-1], axis=1) if used.size else used
    last_read = np.where(reads, np.arange(reads.shape[1]), 0).max(axis=1, initial=0)
    last_read_of_level = np.zeros(level_starts.size, np.int64)
    np.maximum.at(last_read_of_level, level_of_column, np.maximum(last_read, level_of_column))
    return level_starts[1:][np.maximum.accumulate(last_read_of_level)[level_of_column]]


def _pack_box(
    lower: Floats, upper: Floats, network: Network, order: Integers, base_f: int, base_i: int
) -> tuple[Floats, Integers]:
    """The root cell: the box, with all states of all units open."""
    n_knots = sum(unit.table.knots.size for unit in network.units if unit.table is not None)
    corners = np.array([[(v >> axis) & 1 for axis in range(3)] for v in range(8)])
    positions = np.where(corners == 1, upper, lower)
    tags = np.zeros((8, 3), np.int64)
    neighbours = np.zeros((8, 3), np.int64)
    for v, corner in enumerate(corners):
        # Axes x, y, z are counter-clockwise seen from the all-upper corner; every lower side reverses the order.
        axes = (0, 1, 2) if corner.sum() % 2 == 1 else (0, 2, 1)
        for i, axis in enumerate(axes):
            tags[v, i] = 2 * (n_knots + 2 * axis + corner[axis])
            neighbours[v, i] = v ^ (1 << axis)
    levels = network.unit_level[order]
    pieces = np.array([network.units[g].table.knots.size for g in order], np.int64)
    padded_pieces = []
    for level in range(int(levels.max()) + 1 if levels.size else 0):
        members = pieces[levels == level]
        padded_pieces.append(np.pad(members, (0, -members.size % WIDE)))
    high = np.concatenate([*padded_pieces, np.zeros(0, np.int64)])
    header = np.zeros(CELL_HEADER, np.int64)
    header[CELL_SYSTEM_F], header[CELL_SYSTEM_I] = 0, 0
    header[CELL_VERTICES] = header[CELL_CAPACITY] = 8
    header[CELL_FLOATS] = base_f
    integers = np.concatenate([header, np.zeros_like(high), high, tags.reshape(-1), neighbours.reshape(-1)])
    header_end_f, header_end_i = base_f + 24, base_i + integers.size
    integers[CELL_END_F], integers[CELL_END_I] = header_end_f, header_end_i
    return positions.T.reshape(-1), integers.astype(np.int64)
