"""How far an evaluation in floating point may be from the exact value: running error analysis of a whole network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.evaluator import Evaluator, FunctionGroup, SmoothFunction, validated_points
from mn_onnx.ir.levels import contiguous
from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.scalar.running_error import running_error

DOUBLE = 2.0**-53
# Operations per term besides the dot product itself: scaling, bias, normalisation and casts that were fused into a row.
FUSED_OPERATIONS = 8


def _row_rounding(values: Floats, weights: Floats, bias: Floats, unit: float) -> Floats:
    """Rounding errors [n, r] of rows over ``values`` [n, c], for any order of summation.

    ``|sum computed - sum| <= gamma_k sum |w v|`` with ``gamma_k = k u / (1 - k u)`` (Higham, section 3.1).
    """
    operations = (weights.shape[1] + FUSED_OPERATIONS) * unit
    gamma = operations / (1 - min(operations, 0.5))
    spread: Floats = gamma * (np.abs(values) @ np.abs(weights).T + np.abs(bias))
    return spread


@dataclass(eq=False)
class _Level:
    """A level at a chunk of points: slopes and local errors of its outputs [n, o], rounding of its rows [n, u].

    ``bends``: [n, o], what changes of slope within the error of a pre-activation add.
    """

    slopes: Floats
    local: Floats
    bends: Floats
    rounding: Floats


def _apply(
    group: FunctionGroup, t: Floats, t_error: Floats, unit: float
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """(values, slopes, local errors, bends, total errors) of a function at ``t`` known up to ``t_error``."""
    function = group.function
    value, slope = function.values(t), function.slopes(t)
    if isinstance(function, SmoothFunction):
        _, total = running_error(function.expression, t, t_error, unit)
        _, local = running_error(function.expression, t, np.zeros_like(t), unit)
        return value, slope, local, _change_of_slope(function, t, t_error, slope) * t_error, total
    # A product and a sum; and where a knot lies within the error of t, what another slope would change.
    steepness = function.steepness
    local = 3 * unit * (np.abs(value) + steepness * np.abs(t))
    total = steepness * t_error + local
    flattest, steepest = function.slopes_between(t - t_error, t + t_error)
    return value, slope, local, np.maximum(steepest - slope, slope - flattest) * t_error, total


def _change_of_slope(function: SmoothFunction, t: Floats, t_error: Floats, slope: Floats) -> Floats:
    """How much the slope differs within ``t_error`` of ``t``: at a knot, as of relu, all of it; 0 where undefined."""
    with np.errstate(all="ignore"):
        changes = [np.abs(function.slopes(t + side * t_error) - slope) for side in (-1.0, 1.0)]
    change: Floats = np.fmax(*changes)
    return np.where(np.isfinite(change), change, 0.0)


def rounding_error_bound(
    network: Network, points: Floats, *, unit_roundoff: float, true_functions: bool = True
) -> Floats:
    """A bound, float64 [n], on ``|computed - exact|`` of ``f`` at ``points`` (float64 [n, input_dim]).

    ``computed``: by any program that evaluates the network's layers in floating point of ``unit_roundoff`` (2**-24 for
    float32, 2**-11 for float16) with points that are representable, sums in any order, and functions accurate to a few
    units in the last place. Forward, the errors of all pre-activations are bounded; backward, each rounding is weighted
    with the derivative of the output by it: ``sum |df/dt| rounding``, to first order where functions are smooth.
    ``true_functions``: analyse the units' true functions rather than their tables.
    """
    return rounding_error_bounds(network, points, unit_roundoff=unit_roundoff, true_functions=true_functions)[1]


def rounding_error_bounds(
    network: Network, points: Floats, *, unit_roundoff: float, true_functions: bool = True
) -> tuple[Floats, Floats]:
    """Two bounds, float64 [n] each: where no slope changes within the error of a pre-activation, and anywhere.

    The second is `rounding_error_bound`. In deep networks it says little: forward errors grow with every level, in the
    worst case, until there is a knot within them at every point. The first holds nearly everywhere.
    """
    points = validated_points(network, points)
    evaluator = Evaluator(network, true_functions=true_functions)
    smooth, anywhere = np.empty(points.shape[0]), np.empty(points.shape[0])
    for chunk in evaluator.chunks(points):
        smooth[chunk], anywhere[chunk] = _chunk_bounds(evaluator, points[chunk], unit_roundoff)
    return smooth, anywhere


def _chunk_bounds(evaluator: Evaluator, points: Floats, unit: float) -> tuple[Floats, Floats]:
    network = evaluator.network
    values = np.empty((points.shape[0], network.n_variables))
    values[:, : network.input_dim] = points
    errors = np.zeros_like(values)
    levels = []
    for block, groups in evaluator.levels:
        columns = contiguous(block.columns)
        below = values[:, columns]
        t = below @ block.weights.T + block.bias
        rounding = _row_rounding(below, block.weights, block.bias, unit)
        t_error = errors[:, columns] @ np.abs(block.weights).T + rounding
        slopes, local, bends = np.empty((3, t.shape[0], block.outputs.size))
        level = _Level(slopes, local, bends, rounding)
        for group in groups:
            place = contiguous(np.searchsorted(block.outputs, np.arange(network.n_variables)[group.outputs]))
            at = group.positions
            applied = _apply(group, t[:, at], t_error[:, at], unit)
            values[:, group.outputs], slopes[:, place], local[:, place], bends[:, place] = applied[:4]
            errors[:, group.outputs] = applied[4]
        levels.append(level)
    row = network.output
    weights = row.weights[None, :]
    smooth = _row_rounding(values[:, contiguous(row.columns)], weights, np.array([row.bias]), unit)[:, 0]
    bent = np.zeros_like(smooth)
    adjoint = np.zeros_like(values)
    adjoint[:, row.columns] = weights
    for (block, _), level in zip(reversed(evaluator.levels), reversed(levels), strict=True):
        of_outputs = adjoint[:, contiguous(block.outputs)]
        smooth += (np.abs(of_outputs) * level.local).sum(axis=1)
        bent += (np.abs(of_outputs) * level.bends).sum(axis=1)
        of_units = block.sum_outputs(of_outputs * level.slopes)
        smooth += (np.abs(of_units) * level.rounding).sum(axis=1)
        adjoint[:, contiguous(block.columns)] += of_units @ block.weights
    return smooth, smooth + bent


def float64_error_bound(network: Network, points: Floats) -> Floats:
    """`rounding_error_bound` of the tables in float64, float64 [n]: what `evaluate` may be off by."""
    return rounding_error_bound(network, points, unit_roundoff=DOUBLE, true_functions=False)
