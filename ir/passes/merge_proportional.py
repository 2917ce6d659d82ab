"""Units of one level with proportional pre-activations become one unit with several outputs.

Otherwise hyperplanes of one level would coincide or be parallel: a positional encoding becomes one unit per coordinate
whose outputs are all its sines and cosines, duplicates disappear, ``relu(t)`` and ``relu(-t)`` share their knot.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.levels import affine_row, dense_rows, level_blocks, used_columns
from mn_onnx.ir.network import Floats, Integers, KnotTable, Network, ScalarFunction, Unit
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.passes.renaming import rename
from mn_onnx.ir.proportional import pivots, proportional_groups
from mn_onnx.ir.scalar import rewrite
from mn_onnx.ir.spec import no_proportional_rows, nothing_affine, well_formed
from mn_onnx.ir.tables import substitute

# Offsets between proportional rows that rounding of their biases explains are zero.
OFFSET_ULPS = 8


def _substitute_variable(expression: Expression, argument: Expression) -> Expression:
    if expression == T:
        return argument
    if not expression.arguments:
        return expression
    return Expression(expression.op, tuple(_substitute_variable(inner, argument) for inner in expression.arguments))


def in_terms_of(function: ScalarFunction, scale: float, offset: float) -> ScalarFunction:
    """The function of ``s`` that ``function`` is of ``t = scale * s + offset``."""
    if scale == 1.0 and offset == 0.0:
        return function
    if isinstance(function, KnotTable):
        return substitute(function, scale, offset)
    argument = apply("add", apply("multiply", constant(scale), T), constant(offset))
    return rewrite(_substitute_variable(function, rewrite(argument)))


def _identity(function: ScalarFunction) -> Hashable:
    """Equal for equal functions."""
    if isinstance(function, Expression):
        return function
    parts = (function.knots, function.slopes, function.intercepts, function.errors)
    return tuple(part.tobytes() for part in parts)


def _merge_group(units: list[Unit], scales: Floats, offsets: Floats) -> tuple[Unit, list[int]]:
    """One unit for all, over the first one's row; and for every old output in order its place in the new one."""
    functions: dict[Hashable, tuple[int, ScalarFunction]] = {}
    places = []
    for unit, scale, offset in zip(units, scales.tolist(), offsets.tolist(), strict=True):
        for function in unit.functions:
            changed = in_terms_of(function, scale, offset)
            place, _ = functions.setdefault(_identity(changed), (len(functions), changed))
            places.append(place)
    names = dict.fromkeys(unit.name for unit in units)
    name = units[0].name if len(names) == 1 else f"{units[0].name} (+{len(names) - 1})"
    merged = replace(units[0], functions=tuple(function for _, function in functions.values()), name=name, table=None)
    return merged, places


class _Merger:
    """Level by level: new units, and the new variable of every old one."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.position = np.full(network.n_variables, -1)
        self.position[: network.input_dim] = np.arange(network.input_dim)
        self.units: dict[int, tuple[Unit, list[int]]] = {}
        self.modified = False

    def merge_level(self, members: Integers) -> None:
        # Rows over old variables, where merged outputs stand for one another.
        rows = [rename(self.network.units[index].row, self.position) for index in members]
        columns = used_columns(rows)
        weights = dense_rows(rows, columns)
        bias = np.array([row.bias for row in rows], np.float64)
        for group in proportional_groups(weights):
            first = group[0]
            scales = np.ones(1)
            if len(group) > 1:
                at_pivot = weights[group, pivots(weights[[first]])[0]]
                scales = at_pivot / at_pivot[0]
            offsets = bias[group] - scales * bias[first]
            noise = OFFSET_ULPS * np.finfo(np.float64).eps * (np.abs(bias[group]) + np.abs(scales * bias[first]))
            offsets[np.abs(offsets) <= noise] = 0.0
            units = [self.network.units[members[member]] for member in group]
            merged, places = _merge_group(units, scales, offsets)
            self.modified |= len(group) > 1 or merged.n_outputs < units[0].n_outputs
            row = affine_row(columns, weights[first], float(bias[first]))
            home = int(members[first])
            old = np.concatenate([self._outputs(int(members[member])) for member in group])
            # The merged unit's outputs are known by the first old output that equals each.
            representatives = [int(old[places.index(place)]) for place in range(merged.n_outputs)]
            self.position[old] = np.array(representatives)[places]
            self.units[home] = (replace(merged, row=row), representatives)

    def _outputs(self, index: int) -> Integers:
        return np.arange(self.network.first_variable[index], self.network.first_variable[index + 1])

    def result(self) -> Network:
        final = np.full(self.network.n_variables, -1)
        final[: self.network.input_dim] = np.arange(self.network.input_dim)
        count = self.network.input_dim
        ordered = [self.units[home] for home in sorted(self.units)]
        for unit, representatives in ordered:
            final[representatives] = np.arange(count, count + unit.n_outputs)
            count += unit.n_outputs
        units = tuple(replace(unit, row=rename(unit.row, final)) for unit, _ in ordered)
        output = rename(self.network.output, final[self.position])
        return replace(self.network, units=units, output=output)


def _run(program: Program) -> tuple[Program, bool]:
    merger = _Merger(program.network)
    for block in level_blocks(program.network):
        merger.merge_level(block.units)
    if not merger.modified:
        return program, False
    return replace(program, network=merger.result()), True


MERGE_PROPORTIONAL = Pass("merge proportional units", _run, (well_formed, nothing_affine), (no_proportional_rows,))
