"""The true network on patches of a surface: an affine function of the place, and how far the network is from it.

On a small patch every smooth function is close to one line. With these lines, going from the inputs up, every variable
of the true network is an affine *form* in the place up to a radius, which shrinks with the square of the patch's size;
and so is ``f_true``:

    f_true(x) = l(x) + sum over unit outputs of adjoint * (phi - line)

with the constant derivative of ``l`` by each output as its *adjoint*. The relaxations are those of Zhang et al.,
"Efficient Neural Network Robustness Certification with General Activation Functions", NeurIPS 2018, with parallel
sides. All that is computed in float64 is widened by its rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.kernels.patches import (
    EPS,
    Polygons,
    Relaxed,
    Tables,
    output_forms,
    patch_extents,
    patch_moments,
    polygon_maxima,
    relax_level,
)
from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, KnotTable, Network
from mn_onnx.ir.surrogate.close_table import close_table

CHUNK_BYTES = 1 << 21
"""Working memory of one thread, about: what its caches hold."""


@dataclass(frozen=True, eq=False)
class _Level:
    """A level of units with close tables of their true functions.

    ``columns``, ``outputs``: those of ``block``, as slices where they are consecutive. ``kind``: int64 [o]. ``size``:
    [u, c], the magnitudes of the weights with room for rounding. ``limits``: bounds of the pre-activations, [u] each.
    """

    block: LevelBlock
    columns: slice | Integers
    outputs: slice | Integers
    tables: Tables
    kind: Integers
    size: Floats
    limits: tuple[Floats, Floats]


class PatchBound:
    """The bound for patches of polygons of one network in one box."""

    def __init__(self, network: Network, lower: Floats, upper: Floats) -> None:
        self.network = network
        t_lower, t_upper = unit_bounds(network, lower, upper)
        self.levels = [
            _level(network, block, (t_lower[block.units], t_upper[block.units])) for block in level_blocks(network)
        ]
        widest = max([network.output.columns.size, *(level.block.columns.size for level in self.levels)])
        self.rounding = 2 * EPS * (widest + 8)
        per_patch = 8 * (network.input_dim + 8) * network.n_variables
        self.chunk = max(16, CHUNK_BYTES // per_patch)

    def __call__(self, polygons: Polygons, order: Indices, begins: Integers, ends: Integers, errors: Floats) -> Floats:
        """Fill in the ``errors`` of polygons ``order[begins[k]:ends[k]]``, patch by patch.

        Returns how far ``f_true`` may be from an affine function on each patch, [n].
        """
        radii = np.empty(begins.size)
        for first in range(0, begins.size, self.chunk):
            chunk = slice(first, first + self.chunk)
            radii[chunk] = self._patches(polygons, order, begins[chunk], ends[chunk], errors)
        return radii

    def _patches(self, polygons: Polygons, order: Indices, begins: Integers, ends: Integers, errors: Floats) -> Floats:
        n, d, variables = begins.size, self.network.input_dim, self.network.n_variables
        centre, moments, half = np.empty((n, d)), np.empty((n, d, d)), np.empty((n, d))
        patch_moments(polygons, order, begins, ends, centre, moments)
        axes = np.ascontiguousarray(np.swapaxes(np.linalg.eigh(moments)[1], 1, 2))
        patch_extents(polygons, order, begins, ends, centre, axes, half)
        forms, sizes = np.empty((n, 1 + d, variables)), np.zeros((n, 2, variables))
        forms[:, 0, :d], forms[:, 1:, :d] = centre, axes
        sizes[:, 1, :d] = self.rounding * (np.abs(centre) + np.einsum("nik,ni->nk", np.abs(axes), half))
        done = [self._advance(level, half, forms, sizes) for level in self.levels]
        row = self.network.output
        of_output = forms[:, :, row.columns] @ row.weights
        of_output[:, 0] += row.bias
        radius, rounding = (sizes[:, :, row.columns] @ np.abs(row.weights)).T * (1 + self.rounding)
        steepness = np.abs(of_output[:, 1:])
        reach = np.abs(of_output[:, 0]) + (steepness * half).sum(axis=1) + abs(row.bias)
        rounding = rounding + self.rounding * (reach + radius * len(self.levels))
        # Places are known up to the rounding of coordinates.
        rounding += 16 * EPS * steepness.sum(axis=1) * (np.abs(centre).sum(axis=1) + half.sum(axis=1))
        radius = np.asarray(np.minimum(radius, self._radius(done)) + rounding)
        world = np.concatenate([of_output[:, :1], np.einsum("ni,nik->nk", of_output[:, 1:], axes)], axis=1)
        polygon_maxima(polygons, order, begins, ends, centre, world, radius, errors)
        return radius

    def _advance(self, level: _Level, half: Floats, forms: Floats, sizes: Floats) -> Relaxed:
        """Relax a level, and fill in the forms and sizes of its outputs."""
        block, (n, rows, variables) = level.block, forms.shape
        units, outputs = block.units.size, block.outputs.size
        of_t = (forms.reshape(-1, variables)[:, level.columns] @ block.weights.T).reshape(n, rows, units)
        of_t[:, 0] += block.bias
        t_sizes = (sizes.reshape(-1, variables)[:, level.columns] @ level.size.T).reshape(n, 2, units)
        t_sizes[:, 1] += self.rounding * np.abs(block.bias)
        relaxed = Relaxed(np.empty((n, outputs)), np.empty((n, outputs)), np.empty((n, outputs)))
        relax_level(level.tables, block.owner, level.kind, level.limits, (of_t, t_sizes), half, relaxed)
        output_forms(relaxed, block.owner, block.outputs, (of_t, t_sizes), half, self.rounding, (forms, sizes))
        return relaxed

    def _radius(self, done: list[Relaxed]) -> Floats:
        """The sum of ``|adjoint| * error`` over all unit outputs, [n]."""
        n = done[0].slope.shape[0]
        adjoint, total = np.zeros((n, self.network.n_variables)), np.zeros(n)
        adjoint[:, self.network.output.columns] = self.network.output.weights
        for level, relaxed in zip(reversed(self.levels), reversed(done), strict=True):
            of_outputs = adjoint[:, level.outputs]
            total += np.einsum("no,no->n", np.abs(of_outputs), relaxed.error)
            adjoint[:, level.columns] += level.block.sum_outputs(of_outputs * relaxed.slope) @ level.block.weights
        return total


def _level(network: Network, block: LevelBlock, limits: tuple[Floats, Floats]) -> _Level:
    tables, kind = _kinds(network, block, limits)
    size = np.abs(block.weights) * (1 + 2 * EPS * (block.columns.size + 8))
    return _Level(block, contiguous(block.columns), contiguous(block.outputs), tables, kind, size, limits)


def _kinds(network: Network, block: LevelBlock, limits: tuple[Floats, Floats]) -> tuple[Tables, Integers]:
    """The kinds of a level, each on the hull of the ranges of its units, and each output's kind."""
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
    tables = []
    for number, places in enumerate(members.values()):
        index = block.units[block.owner[places[0]]]
        unit, output = network.units[index], int(block.outputs[places[0]] - network.first_variable[index])
        owners = block.owner[places]
        lowest, highest = float(limits[0][owners].min()), float(limits[1][owners].max())
        tables.append(close_table(unit.functions[output], cast(KnotTable, unit.table), output, lowest, highest))
        kind[places] = number
    return _flat(tables), kind


def _flat(tables: list[KnotTable]) -> Tables:
    return Tables(
        np.concatenate([np.zeros(1, np.int64), np.cumsum([table.knots.size + 1 for table in tables])]),
        np.concatenate([np.concatenate([[-np.inf], table.knots]) for table in tables]),
        np.concatenate([table.slopes[0] for table in tables]),
        np.concatenate([table.intercepts[0] for table in tables]),
        np.concatenate([table.errors[0] for table in tables]),
    )
