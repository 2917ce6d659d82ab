"""Certified bounds of pre-activations and of the output over a box.

Two enclosures are intersected: interval arithmetic level by level, and a backward pass that carries linear relaxations
of the units to the inputs (Zhang et al., "Efficient Neural Network Robustness Certification with General Activation
Functions", NeurIPS 2018). Here a unit is relaxed by one slope and a range of offsets, so one backward pass gives both
sides. Tables are widened by their errors: the bounds hold for the network of tables and for the one of true functions.
"""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, Network, Unit
from mn_onnx.ir.relaxation import Relaxation, relax_units
from mn_onnx.ir.scalar import UndefinedFunction


class BoundPropagation:
    """Bounds of a network's levels, computed from the inputs up.

    ``lower``, ``upper``: the box, float64 [input_dim]. Call `pre_activations` and then `add_level` for every level in
    order; the units given to `add_level` may carry tables that the network's own did not have yet.
    """

    def __init__(self, network: Network, lower: Floats, upper: Floats) -> None:
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if lower.shape != (network.input_dim,) or upper.shape != (network.input_dim,):
            raise ValueError(f"the box of this network needs {network.input_dim} lower and upper bounds")
        if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
            raise ValueError(f"the box must be finite with lower <= upper, not {lower.tolist()} to {upper.tolist()}")
        self.network = network
        self.lower, self.upper = np.empty(network.n_variables), np.empty(network.n_variables)
        self.lower[: network.input_dim], self.upper[: network.input_dim] = lower, upper
        self._slope = np.zeros(network.n_variables)
        self._centre = np.zeros(network.n_variables)
        self._radius = np.zeros(network.n_variables)
        self._done: list[LevelBlock] = []

    def rows(self, columns: Integers, weights: Floats, bias: Floats) -> tuple[Floats, Floats]:
        """Bounds [r] of affine rows ``v[columns] @ weights.T + bias`` over variables of the levels added so far."""
        middle = 0.5 * (self.lower[columns] + self.upper[columns])
        spread = 0.5 * (self.upper[columns] - self.lower[columns])
        centre = weights @ middle + bias
        size = np.abs(weights)
        # Rounding of sums of this many terms, with the relaxations' own (Higham, Accuracy and Stability, section 3.1).
        unit = (columns.size + 8) * np.finfo(np.float64).eps
        radius = size @ spread
        radius += unit * (size @ (np.abs(middle) + spread) + np.abs(bias))
        lower, upper = centre - radius, centre + radius
        if self._done:
            backward = self._backward(columns, weights, bias)
            lower, upper = np.maximum(lower, backward[0]), np.minimum(upper, backward[1])
        return lower, upper

    def _backward(self, columns: Integers, weights: Floats, bias: Floats) -> tuple[Floats, Floats]:
        dimension = self.network.input_dim
        adjoint = np.zeros((weights.shape[0], self.network.n_variables))
        adjoint[:, columns] = weights
        constant, radius = bias.astype(np.float64), np.zeros(weights.shape[0])
        size = np.abs(bias)
        eps = np.finfo(np.float64).eps
        for block in reversed(self._done):
            of_outputs = adjoint[:, contiguous(block.outputs)]
            if not of_outputs.any():
                continue
            constant = constant + of_outputs @ self._centre[block.outputs]
            radius = radius + np.abs(of_outputs) @ self._radius[block.outputs]
            of_units = block.sum_outputs(of_outputs * self._slope[block.outputs])
            constant += of_units @ block.bias
            magnitude = np.abs(of_units)
            reach = np.maximum(np.abs(self.lower[block.columns]), np.abs(self.upper[block.columns]))
            size = size + np.abs(of_outputs) @ np.abs(self._centre[block.outputs])
            size += magnitude @ (np.abs(block.weights) @ reach + np.abs(block.bias))
            radius += (block.units.size + block.columns.size) * eps * size
            adjoint[:, contiguous(block.columns)] += of_units @ block.weights
        of_inputs = adjoint[:, :dimension]
        lower, upper = self.lower[:dimension], self.upper[:dimension]
        constant = constant + of_inputs @ (0.5 * (lower + upper))
        radius = radius + np.abs(of_inputs) @ (0.5 * (upper - lower))
        radius += (dimension + 8) * eps * (np.abs(constant) + np.abs(of_inputs) @ np.maximum(-lower, upper))
        return constant - radius, constant + radius

    def pre_activations(self, block: LevelBlock) -> tuple[Floats, Floats]:
        """Bounds of the pre-activations of the next level, float64 [u] each."""
        return self.rows(block.columns, block.weights, block.bias)

    def add_level(self, block: LevelBlock, units: list[Unit], lower: Floats, upper: Floats) -> Relaxation:
        """Take in the level's ``units`` with their pre-activations in ``[lower, upper]``."""
        relaxation = relax_units(units, lower, upper)
        finite = np.isfinite(relaxation.lower) & np.isfinite(relaxation.upper)
        if not finite.all():
            unit = units[int(block.owner[np.flatnonzero(~finite)[0]])]
            raise UndefinedFunction(f"{unit.name}: its function is unbounded or undefined on its range over the box")
        self._slope[block.outputs] = relaxation.slope
        self._centre[block.outputs] = 0.5 * (relaxation.lower + relaxation.upper)
        self._radius[block.outputs] = 0.5 * (relaxation.upper - relaxation.lower)
        self.lower[block.outputs], self.upper[block.outputs] = relaxation.least, relaxation.greatest
        self._done.append(block)
        return relaxation

    def output(self) -> tuple[float, float]:
        """Bounds of the network's value, once all levels are added."""
        row = self.network.output
        lower, upper = self.rows(row.columns, row.weights[None, :], np.array([row.bias]))
        return float(lower[0]), float(upper[0])


def _propagate(network: Network, lower: Floats, upper: Floats) -> tuple[BoundPropagation, Floats, Floats]:
    propagation = BoundPropagation(network, lower, upper)
    t_lower, t_upper = np.empty(len(network.units)), np.empty(len(network.units))
    for block in level_blocks(network):
        low, high = propagation.pre_activations(block)
        t_lower[block.units], t_upper[block.units] = low, high
        propagation.add_level(block, [network.units[index] for index in block.units], low, high)
    return propagation, t_lower, t_upper


def unit_bounds(network: Network, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Bounds of every unit's pre-activation over the box ``lower``..``upper`` (float64 [input_dim]), float64 [units].

    Raises ``ValueError`` for an invalid box, or a unit whose function is unbounded or undefined there.
    """
    _, t_lower, t_upper = _propagate(network, lower, upper)
    return t_lower, t_upper


def output_bounds(network: Network, lower: Floats, upper: Floats) -> tuple[float, float]:
    """Bounds of ``f`` over the box ``lower``..``upper`` (float64 [input_dim]); raises as `unit_bounds`."""
    return _propagate(network, lower, upper)[0].output()
