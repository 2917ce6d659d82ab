"""Removal of unit outputs, and units, that no later row reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mn_onnx.ir.network import KnotTable, Network, Unit
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.passes.renaming import rename
from mn_onnx.ir.spec import all_used, well_formed


def used_variables(network: Network) -> np.ndarray:
    """Whether the output depends on the variable through the rows, bool [n_variables]."""
    used = np.zeros(network.n_variables, bool)
    used[network.output.columns] = True
    for index in range(len(network.units) - 1, -1, -1):
        first, stop = network.first_variable[index : index + 2]
        if used[first:stop].any():
            used[network.units[index].row.columns] = True
    return used


def keep_outputs(unit: Unit, kept: np.ndarray) -> Unit:
    """``unit`` with those of its outputs (bool [n_outputs]) only."""
    functions = tuple(function for function, keep in zip(unit.functions, kept, strict=True) if keep)
    table = unit.table
    if table is not None:
        table = KnotTable(table.knots, table.slopes[kept], table.intercepts[kept], table.errors[kept])
    return replace(unit, functions=functions, table=table)


def _run(program: Program) -> tuple[Program, bool]:
    network = program.network
    used = used_variables(network)
    if used[network.input_dim :].all():
        return program, False
    position = np.cumsum(used | (np.arange(used.size) < network.input_dim)) - 1
    units = []
    for index, unit in enumerate(network.units):
        kept = used[network.first_variable[index] : network.first_variable[index + 1]]
        if kept.any():
            reduced = unit if kept.all() else keep_outputs(unit, kept)
            units.append(replace(reduced, row=rename(unit.row, position)))
    output = rename(network.output, position)
    return replace(program, network=replace(network, units=tuple(units), output=output)), True


REMOVE_UNUSED = Pass("remove unused units", _run, (well_formed,), (all_used,))
