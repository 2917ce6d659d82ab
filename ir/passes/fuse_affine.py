"""Affine outputs of units move into the rows that read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mn_onnx.ir import scalar
from mn_onnx.ir.levels import affine_row, dense_rows, level_blocks, used_columns
from mn_onnx.ir.network import AffineRow, Floats, Integers, KnotTable, Network, ScalarFunction, Unit
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.passes.unused import keep_outputs
from mn_onnx.ir.spec import nothing_affine, piecewise_linear_recognised, well_formed


class _Substitution:
    """Every old variable as a new variable, or as an affine form over new variables."""

    def __init__(self, network: Network) -> None:
        self._dimension = network.n_variables
        self.position = np.full(network.n_variables, -1)
        self.position[: network.input_dim] = np.arange(network.input_dim)
        self._form = np.full(network.n_variables, -1)
        self._weights: list[Floats] = []
        self._bias: list[float] = []
        # Old variables serve as columns of the forms until all new positions are known.

    def define(self, variable: int, weights: Floats, bias: float) -> None:
        """``variable`` equals ``weights @ old variables + bias``; these are all kept."""
        self._form[variable] = len(self._weights)
        self._weights.append(weights)
        self._bias.append(bias)

    def rows(self, rows: list[AffineRow]) -> tuple[Floats, Floats]:
        """``rows`` over the kept old variables: dense weights [r, n_variables] and biases [r]."""
        columns = used_columns(rows)
        weights = dense_rows(rows, columns)
        bias = np.array([row.bias for row in rows], np.float64)
        result = np.zeros((len(rows), self._dimension))
        fused = self._form[columns] >= 0
        result[:, columns[~fused]] = weights[:, ~fused]
        if fused.any():
            forms = self._form[columns[fused]]
            matrix = np.array([self._weights[form] for form in forms])
            through = weights[:, fused]
            size = np.abs(result) + np.abs(through) @ np.abs(matrix)
            result += through @ matrix
            # What rounding alone can leave of terms that cancel is no weight.
            noise = (through.shape[1] + 2) * np.finfo(np.float64).eps * size
            result[np.abs(result) <= noise] = 0.0
            bias = bias + through @ np.array([self._bias[form] for form in forms])
        return result, bias


def _affine_form(function: ScalarFunction, is_constant: bool, bias: float) -> tuple[float, float] | None:
    """(slope, intercept) if the function is affine, or its argument the constant ``bias``."""
    if isinstance(function, KnotTable):
        if not function.knots.size:
            return float(function.slopes[0, 0]), float(function.intercepts[0, 0])
        return (0.0, float(function.evaluate(np.array(bias))[0])) if is_constant else None
    return (0.0, float(scalar.evaluate(function, np.array(bias)))) if is_constant else None


def _run(program: Program) -> tuple[Program, bool]:
    network = program.network
    if not nothing_affine(network):
        return program, False
    substitution = _Substitution(network)
    rebuilt: dict[int, tuple[Unit, Floats, float]] = {}
    for block in level_blocks(network):
        weights, biases = substitution.rows([network.units[index].row for index in block.units])
        for index, row, bias in zip(block.units.tolist(), weights, biases.tolist(), strict=True):
            unit = network.units[index]
            forms = [_affine_form(function, not row.any(), bias) for function in unit.functions]
            for offset, form in enumerate(forms):
                if form is not None:
                    slope, intercept = form
                    variable = int(network.first_variable[index]) + offset
                    substitution.define(variable, slope * row, slope * bias + intercept)
            kept = np.array([form is None for form in forms])
            if kept.any():
                rebuilt[index] = (keep_outputs(unit, kept), row, bias)
                first = int(network.first_variable[index])
                substitution.position[first + np.flatnonzero(kept)] = 0
    position = np.where(substitution.position >= 0, 1, 0).cumsum() - 1
    units = tuple(
        replace(unit, row=_dense_to_row(row, bias, position)) for _, (unit, row, bias) in sorted(rebuilt.items())
    )
    output, bias = substitution.rows([network.output])
    row = _dense_to_row(output[0], float(bias[0]), position)
    return replace(program, network=replace(network, units=units, output=row)), True


def _dense_to_row(weights: Floats, bias: float, position: Integers) -> AffineRow:
    columns = np.flatnonzero(weights)
    return affine_row(position[columns], weights[columns], bias)


FUSE_AFFINE = Pass("fuse affine units", _run, (well_formed, piecewise_linear_recognised), (nothing_affine,))
