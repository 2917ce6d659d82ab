"""How far the network of tables is from the network of true functions, over many boxes at once.

The difference obeys an exact linear recursion: with the tables' slopes ``s`` between the two pre-activations,
``dt = W dy`` and ``dy = s dt + e``, where ``|e|`` is at most the table's error at the true pre-activation. Forward,
this bounds ``|dt|`` and so the slopes and errors that can occur; backward, from the output, the signs of the weights
are kept: ``|f_true - f| <= sum |adjoint| error``. Ranges of pre-activations come from linear forms ``c(x) +- r`` over
each box. Bounds are computed in float64 and widened by its rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.levels import LevelBlock, contiguous, level_blocks
from mn_onnx.ir.network import Floats, Integers, Network
from mn_onnx.ir.ranges import OutputRanges

CHUNK_BYTES = 1 << 23


@dataclass(frozen=True, eq=False)
class _Group:
    """Units of a level whose output number ``k`` is the same function: positions in the level, variables, ranges."""

    positions: Integers
    outputs: Integers
    ranges: OutputRanges


@dataclass(eq=False)
class _LevelState:
    """Slopes (middle and half range) and errors of a level's outputs, float64 [n, o]; the backward pass reads them."""

    slope: Floats
    slack: Floats
    error: Floats


@dataclass(frozen=True, eq=False)
class ErrorBounds:
    """``total``: bounds on ``|f_true - f|`` per box, float64 [n]; ``shares``: of the largest, per unit output.

    ``shares``: float64 [n_variables], what the error of each variable contributes to the bound of the worst box.
    """

    total: Floats
    shares: Floats


class ErrorPropagation:
    """The error bounds of a canonical network.

    ``t_lower``, ``t_upper``: known bounds of the pre-activations (float64 [units]) on a box that contains all boxes
    asked for. Raises ``ValueError`` for a unit without a table.
    """

    def __init__(self, network: Network, t_lower: Floats, t_upper: Floats) -> None:
        self.network = network
        self._t_lower, self._t_upper = t_lower, t_upper
        self._levels = [(block, _groups(network, block)) for block in level_blocks(network)]

    def bounds(self, lower: Floats, upper: Floats) -> ErrorBounds:
        """Bounds over the boxes ``lower``..``upper`` (float64 [n, input_dim] each)."""
        total = np.empty(lower.shape[0])
        shares, worst = np.zeros(self.network.n_variables), -np.inf
        size = max(16, CHUNK_BYTES // (8 * self.network.n_variables * (self.network.input_dim + 4)))
        for start in range(0, lower.shape[0], size):
            chunk = slice(start, start + size)
            found, contributions = self._chunk(lower[chunk], upper[chunk])
            total[chunk] = found
            if found.size and found.max() > worst:
                worst = found.max()
                shares = contributions[int(np.argmax(found))]
        return ErrorBounds(total, shares)

    def _chunk(self, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
        n, dimension = lower.shape
        half = 0.5 * (upper - lower)
        # Linear forms of all variables over the box, in units of its half widths: centre, gradient, radius.
        centre = np.zeros((n, self.network.n_variables))
        gradient = np.zeros((n, dimension, self.network.n_variables))
        radius, delta = np.zeros_like(centre), np.zeros_like(centre)
        centre[:, :dimension] = 0.5 * (lower + upper)
        gradient[:, np.arange(dimension), np.arange(dimension)] = half
        states = []
        for block, groups in self._levels:
            states.append(self._advance(block, groups, centre, gradient, radius, delta))
        return self._backward(states, delta)

    def _advance(
        self, block: LevelBlock, groups: list[_Group], centre: Floats, gradient: Floats, radius: Floats, delta: Floats
    ) -> _LevelState:
        columns = contiguous(block.columns)
        size = np.abs(block.weights)
        t_centre = centre[:, columns] @ block.weights.T + block.bias
        t_gradient = gradient[:, :, columns] @ block.weights.T
        rounding = (block.columns.size + 8) * np.finfo(np.float64).eps
        t_radius = radius[:, columns] @ size.T
        t_radius += rounding * (np.abs(centre[:, columns]) @ size.T + np.abs(block.bias) + t_radius)
        t_delta = delta[:, columns] @ size.T * (1 + rounding)
        reach = t_radius + np.abs(t_gradient).sum(axis=1)
        t_lower = np.maximum(t_centre - reach, self._t_lower[block.units])
        t_upper = np.minimum(t_centre + reach, self._t_upper[block.units])
        shape = (centre.shape[0], block.outputs.size)
        state = _LevelState(np.empty(shape), np.empty(shape), np.empty(shape))
        first = np.searchsorted(block.outputs, np.concatenate([group.outputs for group in groups]))
        start = 0
        for group in groups:
            place = first[start : start + group.outputs.size]
            start += group.outputs.size
            at = group.positions
            low, high, off = t_lower[:, at], np.maximum(t_upper[:, at], t_lower[:, at]), t_delta[:, at]
            ranges = group.ranges
            # Where the true pre-activation may lie as well: there the error, and between them the slopes, are needed.
            wide_low = np.maximum(low - off, self._t_lower[block.units[at]])
            wide_high = np.minimum(high + off, self._t_upper[block.units[at]])
            begin, end = ranges.intervals(wide_low), ranges.intervals(wide_high)
            flattest, steepest = ranges.slopes(begin, end)
            state.slope[:, place] = 0.5 * (flattest + steepest)
            state.slack[:, place] = 0.5 * (steepest - flattest)
            state.error[:, place] = ranges.errors(begin, end)
            least, greatest = ranges.values(wide_low, wide_high, begin, end)
            grown = np.maximum(np.abs(flattest), np.abs(steepest)) * off
            delta[:, group.outputs] = np.minimum(grown, greatest - least) + state.error[:, place]
            inner_begin, inner_end = ranges.intervals(low), ranges.intervals(high)
            slope, middle, spread = _relax(ranges, low, high, inner_begin, inner_end)
            centre[:, group.outputs] = slope * t_centre[:, at] + middle
            gradient[:, :, group.outputs] = slope[:, None, :] * t_gradient[:, :, at]
            radius[:, group.outputs] = np.abs(slope) * t_radius[:, at] + spread
        return state

    def _backward(self, states: list[_LevelState], delta: Floats) -> tuple[Floats, Floats]:
        row = self.network.output
        adjoint = np.zeros_like(delta)
        slack = np.zeros_like(delta)
        adjoint[:, row.columns] = row.weights
        contributions = np.zeros_like(delta)
        for (block, _), state in zip(reversed(self._levels), reversed(states), strict=True):
            outputs, columns = contiguous(block.outputs), contiguous(block.columns)
            centre, spread = adjoint[:, outputs], slack[:, outputs]
            contributions[:, outputs] = (np.abs(centre) + spread) * state.error
            of_t = block.sum_outputs(centre * state.slope)
            spread_of_t = block.sum_outputs(np.abs(centre) * state.slack + spread * (np.abs(state.slope) + state.slack))
            rounding = (block.units.size + 8) * np.finfo(np.float64).eps
            size = np.abs(block.weights)
            adjoint[:, columns] += of_t @ block.weights
            slack[:, columns] += (spread_of_t * (1 + rounding) + rounding * np.abs(of_t)) @ size
        grown = 1 + self.network.n_variables * np.finfo(np.float64).eps
        backward = contributions.sum(axis=1)
        forward = delta[:, row.columns] @ np.abs(row.weights)
        return np.minimum(backward, forward) * grown, contributions


def _relax(
    ranges: OutputRanges, low: Floats, high: Floats, begin: Integers, end: Integers
) -> tuple[Floats, Floats, Floats]:
    """(slope, centre, radius): the output lies in ``slope * t + centre +- radius`` for ``t`` in ``[low, high]``."""
    at_low, at_high = ranges.value(low, begin), ranges.value(high, end)
    if ranges.knots.size <= 1:
        width = high - low
        with np.errstate(invalid="ignore", divide="ignore"):
            chord = np.where(begin == end, ranges.slope[begin], (at_high - at_low) / width)
        at_ends = at_low - chord * low
        if not ranges.knots.size:
            return chord, at_ends, np.zeros_like(chord)
        knot = ranges.knots[0]
        at_knot = np.where(begin == end, at_ends, ranges.slope[0] * knot + ranges.intercept[0] - chord * knot)
        return chord, 0.5 * (at_ends + at_knot), 0.5 * np.abs(at_ends - at_knot)
    # Slopes in m +- q keep the output within q |t - t_m| of the line of slope m through its value at the middle.
    flattest, steepest = ranges.slopes(begin, end)
    slope, half = 0.5 * (flattest + steepest), 0.5 * (steepest - flattest)
    middle = 0.5 * (low + high)
    by_slope = half * 0.5 * (high - low)
    at_middle = ranges.value(middle, ranges.intervals(middle))
    least, greatest = ranges.values(low, high, begin, end)
    by_value = 0.5 * (greatest - least)
    flat = by_value < by_slope
    return (
        np.where(flat, 0.0, slope),
        np.where(flat, 0.5 * (greatest + least), at_middle - slope * middle),
        np.where(flat, by_value, by_slope),
    )


def _groups(network: Network, block: LevelBlock) -> list[_Group]:
    found: dict[object, tuple[list[int], list[int], OutputRanges]] = {}
    for position, index in enumerate(block.units.tolist()):
        unit = network.units[index]
        if unit.table is None:
            raise ValueError(f"{unit.name}: it has no table; run the canonical passes first")
        for output in range(unit.n_outputs):
            table = unit.table
            key = (
                table.knots.tobytes(),
                *(part[output].tobytes() for part in (table.slopes, table.intercepts, table.errors)),
            )
            if key not in found:
                found[key] = ([], [], OutputRanges(table, output))
            found[key][0].append(position)
            found[key][1].append(int(network.first_variable[index]) + output)
    return [_Group(np.array(p), np.array(o), ranges) for p, o, ranges in found.values()]
