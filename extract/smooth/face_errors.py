"""Proved bounds on ``|f_true - f|`` on every polygon of a surface that was extracted with surrogates.

On a polygon the surrogate network is affine, so the ranges of its pre-activations are those at the corners, and ``f``
depends on each unit's output with a constant derivative, the *adjoint*. With the enclosures ``D`` of
`mn_onnx.extract.kernels.deviation`

    f_true - f = sum over unit outputs of adjoint * D

exactly: errors of one sign and of the other cancel as far as their enclosures let them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import resolve_threads, run_matrix_blocks
from mn_onnx.extract.kernels.deviation import Tables, advance_errors, corner_ranges, table_values
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, KnotTable, Network
from mn_onnx.ir.surrogate.local_deviation import finer_table

CHUNK_BYTES = 1 << 21
"""Working memory of one thread, about: what its caches hold."""

EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class _Level:
    """A level of units with what bounds its errors.

    ``columns``, ``outputs``: those of ``block``, as slices where they are consecutive. ``kind``: int64 [o]. ``size``:
    [u, c], the magnitudes of the weights with room for rounding. ``limits``: bounds of the pre-activations, [u] each.
    ``rounding``: [u], how far computed pre-activations may be from exact ones anywhere in the box.
    """

    block: LevelBlock
    columns: slice | Integers
    outputs: slice | Integers
    tables: Tables
    finer: Tables
    kind: Integers
    size: Floats
    limits: tuple[Floats, Floats]
    rounding: Floats


def surface_errors(
    network: Network, surface: Surface, lower: Floats, upper: Floats, *, threads: int | None = None
) -> Floats:
    """`polygon_errors` of a surface, float64 [p]."""
    return polygon_errors(network, surface.vertices, surface.offsets, surface.corners, lower, upper, threads=threads)


def polygon_errors(
    network: Network,
    vertices: Floats,
    offsets: NDArray[np.integer],
    corners: NDArray[np.integer],
    lower: Floats,
    upper: Floats,
    *,
    threads: int | None = None,
) -> Floats:
    """Proved bounds on ``|f_true - f|``, float64 [p], on polygons on each of which canonical ``network`` is affine.

    ``vertices``: float64 [v, d], d the dimension of the network; polygon ``i`` is the convex hull of
    ``vertices[corners[offsets[i]:offsets[i + 1]]]`` (two of them for a segment). ``lower``, ``upper``: float64 [d], the
    box that the network was canonicalised for. Raises ``ValueError`` for a network without tables.
    """
    offsets, corners = np.asarray(offsets, np.int64), np.asarray(corners, np.int64)
    errors = np.zeros(offsets.size - 1)
    if not any(unit.table is None or unit.table.errors.any() for unit in network.units) or not errors.size:
        return errors
    bound = _PolygonBound(network, np.asarray(lower, np.float64), np.asarray(upper, np.float64))
    per_polygon = 8 * 10 * network.n_variables
    size = max(32, CHUNK_BYTES // per_polygon)

    def work(first: int, last: int) -> None:
        for block in range(first, last):
            begin, end = block * size, min((block + 1) * size, errors.size)
            mine = corners[offsets[begin] : offsets[end]]
            used, rows = np.unique(mine, return_inverse=True)
            errors[begin:end] = bound(vertices[used], rows.reshape(-1), offsets[begin : end + 1] - offsets[begin])

    run_matrix_blocks(work, -(-errors.size // size), resolve_threads(threads))
    return errors


class _PolygonBound:
    """The bound for chunks of polygons of one network in one box."""

    def __init__(self, network: Network, lower: Floats, upper: Floats) -> None:
        self.network = network
        t_lower, t_upper = unit_bounds(network, lower, upper)
        magnitude = np.zeros(network.n_variables)
        magnitude[: network.input_dim] = np.maximum(np.abs(lower), np.abs(upper))
        rounding = np.zeros(network.n_variables)
        self.levels = [
            _level(network, block, (t_lower[block.units], t_upper[block.units]), magnitude, rounding)
            for block in level_blocks(network)
        ]
        row = network.output
        self.output_rounding = (
            4 * EPS * (row.columns.size + 8) * float(np.abs(row.weights) @ magnitude[row.columns] + abs(row.bias))
        )

    def __call__(self, points: Floats, rows: Integers, offsets: Integers) -> Floats:
        """Bounds [n] of polygons with corners ``points[rows]``, polygon by polygon from ``offsets`` on."""
        n, variables = offsets.size - 1, self.network.n_variables
        at_points = np.empty((points.shape[0], variables))
        at_points[:, : self.network.input_dim] = points
        middle, spread = np.zeros((n, variables)), np.zeros((n, variables))
        found = []
        for level in self.levels:
            block, columns, outputs = level.block, level.columns, level.outputs
            t = at_points[:, columns] @ block.weights.T + block.bias
            values = np.empty((points.shape[0], block.outputs.size))
            table_values(level.tables, block.owner, level.kind, t, values)
            at_points[:, outputs] = values
            low, high = np.empty((n, block.units.size)), np.empty((n, block.units.size))
            corner_ranges(t, rows, offsets, low, high)
            t_middle = middle[:, columns] @ block.weights.T
            t_spread = spread[:, columns] @ level.size.T
            shape = (n, block.outputs.size)
            slope, centre, radius = np.empty(shape), np.empty(shape), np.empty(shape)
            of_t, of_outputs = (t_middle, t_spread), (np.empty(shape), np.empty(shape))
            advance_errors(
                level.tables, level.finer, block.owner, level.kind, (low, high), level.limits, level.rounding, of_t,
                slope, centre, radius, of_outputs,
            )  # fmt: skip
            middle[:, outputs], spread[:, outputs] = of_outputs
            found.append((slope, centre, radius))
        return self._total(n, found)

    def _total(self, n: int, found: list[tuple[Floats, Floats, Floats]]) -> Floats:
        adjoint = np.zeros((n, self.network.n_variables))
        adjoint[:, self.network.output.columns] = self.network.output.weights
        signed, unsigned, size = np.zeros(n), np.zeros(n), np.zeros(n)
        for level, (slope, centre, radius) in zip(reversed(self.levels), reversed(found), strict=True):
            block = level.block
            of_outputs = adjoint[:, level.outputs]
            signed += (of_outputs * centre).sum(axis=1)
            magnitude = np.abs(of_outputs)
            unsigned += (magnitude * radius).sum(axis=1)
            size += (magnitude * np.abs(centre)).sum(axis=1)
            adjoint[:, level.columns] += block.sum_outputs(of_outputs * slope) @ block.weights
        rounding = EPS * (self.network.n_variables + 8) * len(self.levels)
        total: Floats = np.abs(signed) + unsigned + rounding * (size + unsigned) + self.output_rounding
        return total


def _level(
    network: Network, block: LevelBlock, limits: tuple[Floats, Floats], magnitude: Floats, rounding: Floats
) -> _Level:
    """A level prepared; ``magnitude`` and ``rounding`` of its outputs are filled in, [n_variables] each."""
    size = np.abs(block.weights)
    of_t = EPS * (block.columns.size + 8) * (size @ magnitude[block.columns] + np.abs(block.bias))
    of_t += size @ rounding[block.columns]
    tables, finer, kind = _kinds(network, block, limits)
    largest = np.maximum(np.abs(limits[0]), np.abs(limits[1]))[block.owner]
    intercept = np.array([np.abs(tables.intercepts[tables.first[k] : tables.first[k + 1]]).max() for k in kind])
    steepness = tables.steepest[kind]
    magnitude[block.outputs] = steepness * largest + intercept
    rounding[block.outputs] = steepness * of_t[block.owner] + 4 * EPS * magnitude[block.outputs]
    room = 1 + EPS * (block.columns.size + 8)
    columns, outputs = contiguous(block.columns), contiguous(block.outputs)
    return _Level(block, columns, outputs, tables, finer, kind, size * room, limits, of_t)


def _kinds(network: Network, block: LevelBlock, limits: tuple[Floats, Floats]) -> tuple[Tables, Tables, Integers]:
    """The kinds of a level (tables and finer ones on the hull of the ranges of their units), and each output's kind."""
    members: dict[tuple[object, ...], list[int]] = {}
    for place, (position, variable) in enumerate(zip(block.owner.tolist(), block.outputs.tolist(), strict=True)):
        unit = network.units[block.units[position]]
        output = int(variable - network.first_variable[block.units[position]])
        if unit.table is None:
            raise ValueError(f"{unit.name}: it has no table; run the canonical passes first")
        function = unit.functions[output]
        same = function if isinstance(function, Expression) else None
        parts = (unit.table.knots, unit.table.slopes[output], unit.table.intercepts[output], unit.table.errors[output])
        members.setdefault((same, *(part.tobytes() for part in parts)), []).append(place)
    kind = np.empty(block.outputs.size, np.int64)
    tables, finer = [], []
    for number, places in enumerate(members.values()):
        index = block.units[block.owner[places[0]]]
        unit, output = network.units[index], int(block.outputs[places[0]] - network.first_variable[index])
        table = cast(KnotTable, unit.table)
        owners = block.owner[places]
        lowest, highest = float(limits[0][owners].min()), float(limits[1][owners].max())
        own = slice(output, output + 1)
        tables.append(KnotTable(table.knots, table.slopes[own], table.intercepts[own], table.errors[own]))
        finer.append(finer_table(unit.functions[output], table, output, lowest, highest))
        kind[places] = number
    return _flat(tables), _flat(finer), kind


def _flat(tables: list[KnotTable]) -> Tables:
    return Tables(
        np.concatenate([np.zeros(1, np.int64), np.cumsum([table.knots.size + 1 for table in tables])]),
        np.concatenate([np.concatenate([[-np.inf], table.knots]) for table in tables]),
        np.concatenate([table.slopes[0] for table in tables]),
        np.concatenate([table.intercepts[0] for table in tables]),
        np.concatenate([table.errors[0] for table in tables]),
        np.array([np.abs(table.slopes).max() for table in tables]),
    )
