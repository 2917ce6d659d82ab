"""Networks with some of their inputs fixed to numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mn_onnx.ir.network import AffineRow, Floats, KnotTable, Network, Unit
from mn_onnx.ir.scalar import evaluate


def with_fixed_inputs(network: Network, values: Floats) -> Network:
    """``network`` over its first inputs alone, the last ones fixed to ``values`` (float64, fewer than there are).

    Units that depend on nothing else become constants. Raises ``ValueError`` for as many values as inputs, or for a
    network with tables, whose ranges were those of all inputs.
    """
    kept = network.input_dim - values.size
    if kept < 1:
        raise ValueError(f"{values.size} values leave none of the {network.input_dim} inputs")
    fixed = np.zeros(network.n_variables, bool)
    fixed[kept : network.input_dim] = True
    known = np.zeros(network.n_variables)
    known[kept : network.input_dim] = values
    number = np.empty(network.n_variables, np.int64)
    number[:kept] = np.arange(kept)
    n_variables = kept

    def row_without_fixed(row: AffineRow) -> AffineRow:
        of_fixed = fixed[row.columns]
        if not of_fixed.any():
            return AffineRow(number[row.columns], row.weights, row.bias)
        columns = row.columns[of_fixed]
        bias = row.bias + float(row.weights[of_fixed] @ known[columns])
        return AffineRow(number[row.columns[~of_fixed]], row.weights[~of_fixed], bias)

    units: list[Unit] = []
    for index, unit in enumerate(network.units):
        if unit.table is not None:
            raise ValueError(f"{unit.name}: it has a table; inputs are fixed before tables are made")
        row = row_without_fixed(unit.row)
        outputs = slice(int(network.first_variable[index]), int(network.first_variable[index + 1]))
        if row.columns.size:
            number[outputs] = n_variables + np.arange(unit.n_outputs)
            n_variables += unit.n_outputs
            units.append(replace(unit, row=row))
        else:
            fixed[outputs] = True
            known[outputs] = _values(unit, row.bias)
    return replace(network, input_dim=kept, units=tuple(units), output=row_without_fixed(network.output))


def _values(unit: Unit, t: float) -> Floats:
    at = np.array([t])
    return np.array([
        function.evaluate(at)[0, 0] if isinstance(function, KnotTable) else evaluate(function, at)[0]
        for function in unit.functions
    ])  # fmt: skip
