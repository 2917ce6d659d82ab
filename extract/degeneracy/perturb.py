"""A small deterministic perturbation that brings a degenerate arrangement of planes into general position.

Every unit's bias moves by a pseudo-random amount of either sign, relative to the magnitude of its pre-activation, so
that planes which coincide or meet in one point by design no longer do. The output's bias rises by more than all units
together can lower the output: where f is zero on a whole region, the perturbed f is positive there, as zero counts as
positive everywhere. The idea is that of symbolic perturbation (Edelsbrunner and Muecke, "Simulation of simplicity",
1990), carried out in numbers; `mn_onnx.extract.degeneracy.limit` takes the result back to the network as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import AffineRow, Network

Floats = NDArray[np.float64]

N_SAMPLES = 2048
"""Points of the box at which magnitudes are measured."""

OUTPUT_LEAD = 4.0
"""How far the shift of the output exceeds the largest measured effect of the units' shifts."""


@dataclass(frozen=True, eq=False)
class Perturbation:
    """Shifts of the biases of a network: ``units``, float64 [n_units], and ``output``, positive."""

    network: Network
    units: Floats
    output: float

    def at(self, scale: float) -> Network:
        """The network with all shifts times ``scale``."""
        units = tuple(
            replace(unit, row=_shifted(unit.row, scale * shift))
            for unit, shift in zip(self.network.units, self.units, strict=True)
        )
        return replace(self.network, units=units, output=_shifted(self.network.output, scale * self.output))


def perturbation(network: Network, lower: Floats, upper: Floats, *, size: float, seed: int) -> Perturbation:
    """Shifts of about ``size`` relative to the magnitudes that occur in the box; the same for the same arguments.

    ``lower``, ``upper``: float64 [input_dim]. Raises ``ValueError`` for a network that is not canonical.
    """
    generator = np.random.default_rng(seed)
    points = generator.uniform(lower, upper, (N_SAMPLES, network.input_dim))
    unit_magnitudes, output_magnitude = _magnitudes(network, points)
    signs = generator.choice([-1.0, 1.0], len(network.units))
    shifts = size * unit_magnitudes * signs * generator.uniform(0.5, 1.0, len(network.units))
    of_units = Perturbation(network, shifts, 0.0)
    effect = np.abs(evaluate(of_units.at(1.0), points) - evaluate(network, points)).max()
    return replace(of_units, output=OUTPUT_LEAD * float(effect) + size * output_magnitude)


def _shifted(row: AffineRow, shift: float) -> AffineRow:
    return replace(row, bias=row.bias + shift)


def _magnitudes(network: Network, points: Floats) -> tuple[Floats, float]:
    """Per unit, and for the output: ``|bias| + sum |weight| max |variable|`` over ``points``; 1 where that is zero."""
    variables = [np.abs(points).max(axis=0)]
    values = [points.T]
    magnitudes = np.ones(len(network.units))

    def magnitude(row: AffineRow, largest: Floats) -> float:
        return abs(row.bias) + float(np.abs(row.weights) @ largest[row.columns]) or 1.0

    largest = np.empty(network.n_variables)
    columns = np.empty((network.n_variables, points.shape[0]))
    columns[: network.input_dim] = values[0]
    largest[: network.input_dim] = variables[0]
    for index, unit in enumerate(network.units):
        if unit.table is None:
            raise ValueError(f"unit {unit.name} has no knot table; run the canonical passes first")
        outputs = slice(int(network.first_variable[index]), int(network.first_variable[index + 1]))
        magnitudes[index] = magnitude(unit.row, largest)
        columns[outputs] = unit.table.evaluate(unit.row.weights @ columns[unit.row.columns] + unit.row.bias)
        largest[outputs] = np.abs(columns[outputs]).max(axis=1)
    return magnitudes, magnitude(network.output, largest)
