"""Recognition of exactly piecewise-linear functions."""

from __future__ import annotations

from dataclasses import replace

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, ScalarFunction
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.scalar import simplify
from mn_onnx.ir.spec import piecewise_linear_recognised, well_formed


def _recognise(function: ScalarFunction) -> ScalarFunction:
    return function if isinstance(function, KnotTable) else simplify(function)


def _run(program: Program) -> tuple[Program, bool]:
    units = []
    modified = False
    for unit in program.network.units:
        if any(isinstance(function, Expression) for function in unit.functions):
            functions = tuple(_recognise(function) for function in unit.functions)
            modified |= functions != unit.functions
            unit = replace(unit, functions=functions)
        units.append(unit)
    return replace(program, network=replace(program.network, units=tuple(units))), modified


RECOGNISE = Pass("recognise piecewise-linear functions", _run, (well_formed,), (piecewise_linear_recognised,))
