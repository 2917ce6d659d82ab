"""The level moves into the output's bias."""

from __future__ import annotations

from dataclasses import replace

from mn_onnx.ir.network import AffineRow
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.spec import well_formed


def _run(program: Program) -> tuple[Program, bool]:
    row = program.network.output
    if program.level == 0.0:
        return program, False
    output = AffineRow(row.columns, row.weights, row.bias - program.level)
    return replace(program, network=replace(program.network, output=output), level=0.0), True


SUBTRACT_LEVEL = Pass("subtract the level", _run, (well_formed,), (well_formed,))
