"""A monotone function that the output goes through last is inverted at the level.

``{x | w * phi(t(x)) + b = level}`` is ``{x | t(x) = phi^-1((level - b) / w)}``: the output becomes the pre-activation
of the last unit. So Tanh, Sigmoid, a final Clip or scaling cost nothing and lose nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mn_onnx.ir.bounds import output_bounds
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.heads import Inverse, invert_expression, invert_table
from mn_onnx.ir.network import AffineRow, KnotTable, Network
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.spec import piecewise_linear_recognised, well_formed
from mn_onnx.ir.tables import combine, merge


def _head(network: Network) -> tuple[int, KnotTable | Expression, float, float] | None:
    """The unit that the output reads alone: (index, function, weight, bias), ``f = weight * function(t) + bias``."""
    row = network.output
    owners = np.unique(network.variable_unit[row.columns])
    if owners.size != 1 or owners[0] < 0:
        return None
    index = int(owners[0])
    functions = [network.units[index].functions[column - network.first_variable[index]] for column in row.columns]
    if len(functions) == 1:
        return index, functions[0], float(row.weights[0]), row.bias
    tables = [function for function in functions if isinstance(function, KnotTable)]
    if len(tables) < len(functions):
        return None
    return index, combine(merge(tables), row.weights, 0.0), 1.0, row.bias


def _invert(program: Program, index: int, function: KnotTable | Expression, target: float) -> Inverse:
    if isinstance(function, KnotTable):
        return invert_table(function, target)
    network = program.network
    below = replace(network, units=network.units[:index], output=network.units[index].row)
    return invert_expression(function, target, *output_bounds(below, program.lower, program.upper))


def _strip(program: Program) -> Program | None:
    """The program without its outermost head, None if it has none that can be inverted."""
    head = _head(program.network)
    if head is None:
        return None
    index, function, weight, bias = head
    unit = program.network.units[index]
    target = (program.level - bias) / weight
    inverse = _invert(program, index, function, target)
    if inverse.reason:
        value = "" if target == program.level else f", where it would be {target:.9g},"
        described = f"{unit.name}: the level {program.level:.9g}{value} is not reached: {inverse.reason}"
        return replace(program, empty_reason=described)
    if inverse.direction == 0:
        return None
    # The new output increases where the old one does.
    sign = inverse.direction * (1 if weight > 0 else -1)
    output = AffineRow(unit.row.columns, sign * unit.row.weights, sign * unit.row.bias)
    network = replace(program.network, output=output)
    return replace(
        program,
        network=network,
        level=sign * inverse.argument,
        sign=sign * program.sign,
        heads=(*program.heads, unit.name),
    )


def _run(program: Program) -> tuple[Program, bool]:
    imported = program.network
    while not program.empty_reason:
        stripped = _strip(program)
        if stripped is None:
            break
        program = stripped
    return program, program.network is not imported


STRIP_HEADS = Pass("strip monotone heads", _run, (well_formed, piecewise_linear_recognised), (well_formed,))
