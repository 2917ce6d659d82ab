"""Certified bounds on the error of a canonical network with surrogates, ``|f_true - f|``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.error_propagation import ErrorPropagation
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Floats, Network

# Multiplications that a certificate may cost by default: about five seconds.
DEFAULT_WORK = 2e10
SAMPLES = 4096
# Dividing boxes ends once the bound is this close to a difference that was seen.
CLOSE_ENOUGH = 2.0
# What contributes to the error is judged by this many of the worst boxes.
JUDGED_BOXES = 64


@dataclass(frozen=True, eq=False)
class Certificate:
    """``error``: a proved bound on ``|f_true - f|`` on the box. ``sampled``: the largest difference seen there.

    ``boxes``: into how many boxes the box was divided. ``shares``: float64 [n_variables], what the error of each unit
    output contributes at most in the worst of them.
    """

    error: float
    sampled: float
    boxes: int
    shares: Floats


def _has_errors(network: Network) -> bool:
    return any(unit.table is not None and unit.table.errors.any() for unit in network.units)


def certify(
    network: Network, lower: Floats, upper: Floats, *, target: float | None = None, work: float = DEFAULT_WORK
) -> Certificate:
    """Bound the error of canonical ``network`` on the box ``lower``..``upper`` (float64 [input_dim]).

    The box must lie in the one that the network was canonicalised for. It is divided where the bound is largest, until
    the bound is at most ``target`` or ``work`` is used up; without a target, or where samples show that it is not met,
    until the bound is close to what was sampled.
    """
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not _has_errors(network):
        return Certificate(0.0, 0.0, 1, np.zeros(network.n_variables))
    propagation = ErrorPropagation(network, *unit_bounds(network, lower, upper))
    sampled = _sampled_error(network, lower, upper)
    missed = target is not None and sampled > target
    enough = target if target is not None and not missed else CLOSE_ENOUGH * sampled
    # How far a target is missed need not be known closely.
    budget = max(8, int((work / 4 if missed else work) / propagation.work_per_box))
    low, high = lower[None, :], upper[None, :]
    totals, spent = propagation.bounds(low, high), 1
    while totals.max() > enough and spent < budget:
        # All boxes within a factor of the worst are divided, so that no round is wasted on a few.
        chosen = totals > max(enough, 0.5 * totals.max())
        if 2 * chosen.sum() > budget - spent:
            chosen = np.zeros(totals.size, bool)
            chosen[np.argsort(-totals, kind="stable")[: max(1, (budget - spent) // 2)]] = True
        child_low, child_high = _bisect(low[chosen], high[chosen])
        # A part is never worse than the whole, though its own bound may be.
        children = np.minimum(propagation.bounds(child_low, child_high), np.repeat(totals[chosen], 2))
        spent += children.size
        low, high = np.concatenate([low[~chosen], child_low]), np.concatenate([high[~chosen], child_high])
        totals = np.concatenate([totals[~chosen], children])
    worst = np.argsort(-totals, kind="stable")[:JUDGED_BOXES]
    return Certificate(float(totals.max()), sampled, totals.size, propagation.shares(low[worst], high[worst]))


def _bisect(lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Both halves of each box, along its longest side."""
    rows, axis = np.arange(lower.shape[0]), np.argmax(upper - lower, axis=1)
    middle = 0.5 * (lower[rows, axis] + upper[rows, axis])
    low, high = np.repeat(lower, 2, axis=0), np.repeat(upper, 2, axis=0)
    high[0::2][rows, axis] = middle
    low[1::2][rows, axis] = middle
    return low, high


def _sampled_error(network: Network, lower: Floats, upper: Floats) -> float:
    points = np.random.default_rng(0).uniform(lower, upper, (SAMPLES, network.input_dim))
    return float(np.abs(evaluate(network, points, true_functions=True) - evaluate(network, points)).max())
