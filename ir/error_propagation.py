"""How far the network of tables is from the network of true functions, over many boxes at once.

On a box every unit output ``y`` with pre-activation ``t`` is relaxed by one slope ``s``: in the network of tables it is
``s t + m +- r``, and its true value differs by ``s dt + d +- e`` if the true pre-activation differs by ``dt``. Each
pre-activation is an affine combination of outputs of earlier levels, so going backward from it to the inputs,

    t = c . x + constant +- sum |a_k| r_k,    dt = sum a_k d_k +- sum |a_k| e_k,

with the same adjoints ``a_k`` (products of weights and slopes, signs kept) in both. Such backward passes bound ranges
in Zhang et al., "Efficient Neural Network Robustness Certification with General Activation Functions", NeurIPS 2018;
the second sum does for differences what the first does for values. Bounds are computed in float64 and widened by its
rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.cell_relaxation import EPS, CellRelaxations, FlatProfiles, flat_profiles, relax_cells
from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, Network, Unit
from mn_onnx.ir.surrogate.local_deviation import deviation_profile

CHUNK_BYTES = 1 << 23
# What is done for every unit output beside products, in multiplications (measured).
OVERHEAD = 4000


@dataclass(frozen=True, eq=False)
class _Level:
    """Units of a level, and what their outputs follow: output ``j`` the profile ``kind[j]``."""

    block: LevelBlock
    profiles: FlatProfiles
    kind: Integers
    limits: tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class _Relaxed:
    """A level over a chunk of boxes: what a backward pass multiplies adjoints with.

    ``slope``: float64 [n, o]; ``centres`` and ``radii``: float64 [n, o, 2], of the value and of the difference, with
    all rounding.
    """

    slope: Floats
    centres: Floats
    radii: Floats


class ErrorPropagation:
    """The error bounds of a canonical network.

    ``t_lower``, ``t_upper``: known bounds of the pre-activations (float64 [units]) on a box that contains all boxes
    asked for. Raises ``ValueError`` for a unit without a table.
    """

    def __init__(self, network: Network, t_lower: Floats, t_upper: Floats) -> None:
        self.network = network
        self._levels = [
            _level(network, block, (t_lower[block.units], t_upper[block.units])) for block in level_blocks(network)
        ]

    @property
    def work_per_box(self) -> int:
        """What one box costs, in multiplications: a backward pass through all lower levels for every level."""
        below, work = 0, 0
        for level in self._levels:
            work += level.block.units.size * below + OVERHEAD * level.block.outputs.size
            below += level.block.weights.size
        return work + below

    def bounds(self, lower: Floats, upper: Floats) -> Floats:
        """Bounds on ``|f_true - f|``, float64 [n], over the boxes ``lower``..``upper`` (float64 [n, input_dim])."""
        total = np.empty(lower.shape[0])
        for chunk in self._chunks(lower.shape[0]):
            total[chunk], _ = _Chunk(self.network, lower[chunk], upper[chunk]).bound(self._levels)
        return total

    def shares(self, lower: Floats, upper: Floats) -> Floats:
        """What the error of each variable contributes at most to the bound of any of the boxes, [n_variables]."""
        shares = np.zeros(self.network.n_variables)
        for chunk in self._chunks(lower.shape[0]):
            _, contributions = _Chunk(self.network, lower[chunk], upper[chunk]).bound(self._levels)
            shares = np.maximum(shares, contributions.max(axis=0))
        return shares

    def _chunks(self, n: int) -> Iterator[slice]:
        widest = max((level.block.units.size for level in self._levels), default=1)
        size = max(4, CHUNK_BYTES // (8 * self.network.n_variables * widest))
        yield from (slice(start, start + size) for start in range(0, n, size))


class _Chunk:
    """The levels of a network over ``n`` boxes, relaxed from the inputs up."""

    def __init__(self, network: Network, lower: Floats, upper: Floats) -> None:
        self.network = network
        self.centre, self.half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        self.done: list[tuple[LevelBlock, _Relaxed]] = []
        # The largest |value| and |difference| of every variable: what rounding is relative to.
        self.reach = np.zeros((lower.shape[0], 2, network.n_variables))
        self.reach[:, 0, : network.input_dim] = np.abs(self.centre) + self.half

    def bound(self, levels: list[_Level]) -> tuple[Floats, Floats]:
        """Bounds on ``|f_true - f|``, [n], and what every variable contributes, [n, n_variables]."""
        for level in levels:
            self._add(level)
        row = self.network.output
        contributions = np.zeros((self.centre.shape[0], self.network.n_variables))
        centres, radii = self._backward(row.columns, row.weights[None, :], np.array([row.bias]), contributions)
        total = np.abs(centres[:, 0, 1]) + radii[:, 0, 1]
        return total * (1 + 4 * EPS), contributions

    def _add(self, level: _Level) -> None:
        block = level.block
        centres, radii = self._backward(block.columns, block.weights, block.bias)
        lower, upper = centres - radii, centres + radii
        least, greatest = level.limits
        of_table = np.clip(lower[:, :, 0], least, greatest), np.clip(upper[:, :, 0], least, greatest)
        of_difference = lower[:, :, 1].copy(), upper[:, :, 1].copy()
        relaxed = relax_cells(level.profiles, block.owner, level.kind, of_table, of_difference, level.limits)
        farthest = np.maximum(np.abs(of_difference[0]), np.abs(of_difference[1]))
        self.reach[:, 0, block.outputs] = relaxed.reach
        self.reach[:, 1, block.outputs] = (
            np.abs(relaxed.slope) * farthest[:, block.owner] + np.abs(relaxed.shift) + relaxed.jump
        )
        self.done.append((block, self._with_rounding(block, relaxed)))

    def _with_rounding(self, block: LevelBlock, relaxed: CellRelaxations) -> _Relaxed:
        # Passing an adjoint through the level rounds every product and sum (Higham, section 3.1).
        size = self.reach[:, :, contiguous(block.columns)] @ np.abs(block.weights).T
        size[:, 0] += np.abs(block.bias)
        rounding = 2 * EPS * (block.units.size + block.columns.size + 8)
        centres = np.stack([relaxed.middle, relaxed.shift], axis=2)
        radii = np.stack([relaxed.spread, relaxed.jump], axis=2)
        radii += rounding * np.abs(relaxed.slope)[:, :, None] * np.moveaxis(size[:, :, block.owner], 1, 2)
        radii += rounding * np.abs(centres)
        return _Relaxed(relaxed.slope, centres, radii * (1 + rounding))

    def _backward(
        self, columns: Integers, weights: Floats, bias: Floats, contributions: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Centres and radii [n, r, 2] of rows ``v[columns] @ weights.T + bias``, and of their differences."""
        n, dimension = self.centre.shape
        adjoint = np.empty((n, weights.shape[0], self.network.n_variables))
        adjoint[:, :, contiguous(columns)] = weights
        # Adjoints of all other variables are zero, and not written before they are needed.
        reached = np.zeros(self.network.n_variables, bool)
        reached[columns] = True
        centres = np.zeros((n, weights.shape[0], 2))
        centres[:, :, 0] = bias
        size = self.reach[:, :, contiguous(columns)] @ np.abs(weights).T
        size[:, 0] += np.abs(bias)
        radii = np.moveaxis(2 * EPS * (columns.size + self.network.n_variables) * size, 1, 2).copy()
        for block, relaxed in reversed(self.done):
            if not reached[block.outputs].any():
                continue
            _clear(adjoint, reached, block.outputs)
            of_outputs = adjoint[:, :, contiguous(block.outputs)]
            magnitude = np.abs(of_outputs)
            radii += magnitude @ relaxed.radii
            centres += of_outputs @ relaxed.centres
            if contributions is not None:
                errors = np.abs(relaxed.centres[:, :, 1]) + relaxed.radii[:, :, 1]
                contributions[:, block.outputs] = magnitude[:, 0] * errors
            of_units = _sum_outputs(block, of_outputs * relaxed.slope[:, None, :])
            centres[:, :, 0] += of_units @ block.bias
            if reached[block.columns].any():
                _clear(adjoint, reached, block.columns)
                adjoint[:, :, contiguous(block.columns)] += of_units @ block.weights
            else:
                adjoint[:, :, contiguous(block.columns)] = of_units @ block.weights
                reached[block.columns] = True
        _clear(adjoint, reached, np.arange(dimension))
        of_inputs = adjoint[:, :, :dimension]
        centres[:, :, 0] += (of_inputs @ self.centre[:, :, None])[:, :, 0]
        radii[:, :, 0] += (np.abs(of_inputs) @ self.half[:, :, None])[:, :, 0]
        return centres, radii


def _clear(adjoint: Floats, reached: NDArray[np.bool_], variables: Integers) -> None:
    """Write zeros where ``variables`` were not reached yet."""
    missing = variables[~reached[variables]]
    if missing.size:
        adjoint[:, :, missing] = 0.0
        reached[missing] = True


def _sum_outputs(block: LevelBlock, of_outputs: Floats) -> Floats:
    n, rows, outputs = of_outputs.shape
    return block.sum_outputs(of_outputs.reshape(n * rows, outputs)).reshape(n, rows, block.units.size)


def _level(network: Network, block: LevelBlock, limits: tuple[Floats, Floats]) -> _Level:
    members: dict[tuple[object, ...], list[int]] = {}
    for place, (position, variable) in enumerate(zip(block.owner.tolist(), block.outputs.tolist(), strict=True)):
        unit, output = _unit_output(network, int(block.units[position]), variable)
        if unit.table is None:
            raise ValueError(f"{unit.name}: it has no table; run the canonical passes first")
        parts = (unit.table.knots, unit.table.slopes[output], unit.table.intercepts[output], unit.table.errors[output])
        smooth = unit.functions[output] if parts[-1].any() else None
        members.setdefault((smooth, *(part.tobytes() for part in parts)), []).append(place)
    kind = np.empty(block.outputs.size, np.int64)
    profiles = []
    for number, places in enumerate(members.values()):
        owners = block.owner[places]
        unit, output = _unit_output(network, int(block.units[owners[0]]), int(block.outputs[places[0]]))
        assert unit.table is not None
        lowest, highest = float(limits[0][owners].min()), float(limits[1][owners].max())
        profiles.append(deviation_profile(unit.functions[output], unit.table, output, lowest, highest))
        kind[places] = number
    return _Level(block, flat_profiles(profiles), kind, limits)


def _unit_output(network: Network, index: int, variable: int) -> tuple[Unit, int]:
    return network.units[index], variable - int(network.first_variable[index])
