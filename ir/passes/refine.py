"""Refinement of the surrogates until the certified error of the output is small enough."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mn_onnx.ir.certify import DEFAULT_WORK, Certificate, certify
from mn_onnx.ir.levels import level_blocks
from mn_onnx.ir.network import KnotTable, Network
from mn_onnx.ir.passes.contract import Program
from mn_onnx.ir.passes.tabulate import SurrogateGroup, surrogate_groups, tabulate
from mn_onnx.ir.scalar import UndefinedFunction

MOST_ROUNDS = 8
# Beyond this many knots per unit on average a traversal is out of reach.
MOST_KNOTS_PER_UNIT = 4096
# Each round aims below the tolerance, because the next ranges and sensitivities are not known yet.
AIM = 0.7
LEAST_FACTOR = 2.0**-10
# Two rounds that gain less than this have met a limit that knots do not move.
LEAST_GAIN = 0.95
# Of a round's proof: four times as many boxes halve the knots, and the polygons go with the square of those.
ROUND_WORK = DEFAULT_WORK


class ToleranceNotReached(ValueError):
    """The error of the output cannot be certified to be as small as asked. ``certificate``: the best one found."""

    def __init__(self, message: str, certificate: Certificate) -> None:
        self.certificate = certificate
        super().__init__(message)


@dataclass(frozen=True)
class _Cost:
    """A surrogate group in the current network: knots of all members, contribution to the error, and its errors now."""

    group: SurrogateGroup
    knots: float
    contribution: float
    errors: tuple[float, ...]


def _costs(network: Network, certificate: Certificate) -> Iterator[_Cost]:
    for level, block in enumerate(level_blocks(network)):
        units = [network.units[index] for index in block.units]
        for group, members in surrogate_groups(units, level).items():
            table = units[members[0]].table
            assert table is not None
            variables = np.concatenate([
                np.arange(network.first_variable[block.units[m]], network.first_variable[block.units[m] + 1])
                for m in members
            ])  # fmt: skip
            knots = float(len(members) * max(1, table.knots.size))
            contribution = float(certificate.shares[variables].sum())
            yield _Cost(group, knots, contribution, _errors(table))


def _errors(table: KnotTable) -> tuple[float, ...]:
    return tuple(table.errors.max(axis=1).tolist())


def _factors(costs: list[_Cost], ratio: float) -> list[float]:
    """By which factor every group's errors shall shrink, so that the sum of contributions shrinks by ``ratio``.

    Knots go with ``error**-1/2``, so the fewest knots in all have errors in proportion to
    ``(knots / contribution)**(2/3)`` (Lagrange multipliers).
    """
    total = sum(cost.contribution for cost in costs)
    if total <= 0:
        return [ratio] * len(costs)
    shape = [(cost.knots * total / max(cost.contribution, 1e-9 * total)) ** (2 / 3) for cost in costs]
    scale = ratio * total / sum(cost.contribution * factor for cost, factor in zip(costs, shape, strict=True))
    return [float(np.clip(scale * factor, LEAST_FACTOR, 1.0)) for factor in shape]


def refine(program: Program, tabulated: Program, tolerance: float) -> tuple[Program, Certificate]:
    """``program`` (without tables) tabulated so that its certified error is at most ``tolerance``, with the proof.

    ``tabulated``: a first attempt, with the default surrogates. Raises `ToleranceNotReached` with the reason.
    """
    current, lower, upper = tabulated, program.lower, program.upper
    certificate = certify(current.network, lower, upper, target=tolerance, work=ROUND_WORK)
    was_stuck = False
    for _ in range(MOST_ROUNDS):
        if certificate.error <= tolerance:
            return current, certificate
        costs = list(_costs(current.network, certificate))
        factors = _factors(costs, AIM * tolerance / certificate.error)
        tolerances = {
            cost.group: tuple(error * factor for error in cost.errors)
            for cost, factor in zip(costs, factors, strict=True)
        }
        expected = sum(cost.knots / np.sqrt(factor) for cost, factor in zip(costs, factors, strict=True))
        if expected > MOST_KNOTS_PER_UNIT * len(current.network.units):
            raise _failure(current.network, certificate, tolerance, f"about {expected:,.0f} knots would be needed")
        try:
            finer = tabulate(replace(program, tolerances=tolerances))
        except UndefinedFunction as fault:
            raise _failure(current.network, certificate, tolerance, str(fault)) from fault
        finer_certificate = certify(finer.network, lower, upper, target=tolerance, work=ROUND_WORK)
        is_stuck = finer_certificate.error > max(tolerance, LEAST_GAIN * certificate.error)
        current, certificate = finer, finer_certificate
        if is_stuck and was_stuck:
            raise _failure(current.network, certificate, tolerance, "more knots no longer improve the proof")
        was_stuck = is_stuck
    if certificate.error <= tolerance:
        return current, certificate
    raise _failure(current.network, certificate, tolerance, f"{MOST_ROUNDS} rounds of refinement were not enough")


def _failure(network: Network, certificate: Certificate, tolerance: float, reason: str) -> ToleranceNotReached:
    worst = int(network.variable_unit[int(np.argmax(certificate.shares))])
    knots = sum(unit.table.knots.size for unit in network.units if unit.table is not None)
    return ToleranceNotReached(
        f"an error of the output of at most {tolerance:.3g} cannot be certified: with {knots:,} knots the proved bound "
        f"is {certificate.error:.3g} (the largest error seen is {certificate.sampled:.3g}), and {reason}; the unit "
        f"that contributes most is {network.units[worst].name}. Choose a larger tolerance or a smaller box, or set the "
        "number of knots per period instead",
        certificate,
    )
