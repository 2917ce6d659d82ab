"""Every unit gets its table: exact for piecewise-linear functions, a surrogate with proved errors for smooth ones.

Levels are done from the inputs up, because the range of a unit depends on the tables below it. Ranges enclose the
values that the pre-activation takes in the network of tables and in the one of true functions. Units of a level with
the same functions share one surrogate over the hull of their ranges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mn_onnx.ir.bounds import BoundPropagation
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import level_blocks
from mn_onnx.ir.network import Floats, Integers, KnotTable, ScalarFunction, Unit
from mn_onnx.ir.passes.contract import Pass, Program
from mn_onnx.ir.scalar import UndefinedFunction
from mn_onnx.ir.spec import no_proportional_rows, nothing_affine, tabulated, well_formed
from mn_onnx.ir.surrogate import bend_profile, error_of_knots, fit, kinks, require_bounded
from mn_onnx.ir.tables import merge

# Ranges are widened by this part of their width, so that rounding in the traversal does not leave them and no knot of
# an encoding coincides with a face of the box.
MARGIN = 2.0**-30
# Functions whose bend is rounding noise get this error, relative to their size, as tolerance.
SMALLEST_TOLERANCE = 2.0**-40


@dataclass(frozen=True)
class SurrogateGroup:
    """Units that share a surrogate: their level (from 0) and their functions."""

    level: int
    functions: tuple[ScalarFunction, ...]


def is_smooth(unit: Unit) -> bool:
    """Whether the unit needs a surrogate."""
    return any(isinstance(function, Expression) for function in unit.functions)


def surrogate_groups(units: list[Unit], level: int) -> dict[SurrogateGroup, list[int]]:
    """The positions in ``units`` (of one level) of the members of each group."""
    groups: dict[SurrogateGroup, list[int]] = {}
    for position, unit in enumerate(units):
        if is_smooth(unit):
            groups.setdefault(SurrogateGroup(level, unit.functions), []).append(position)
    return groups


def default_tolerances(
    functions: tuple[ScalarFunction, ...], lower: float, upper: float, knots_per_period: float
) -> tuple[float, ...]:
    """The sup error that ``knots_per_period`` gives each function on a range; tables count as exact (zero).

    Raises `UndefinedFunction` if a function jumps, is unbounded or undefined on the range.
    """
    tolerances = []
    for function in functions:
        if isinstance(function, KnotTable):
            tolerances.append(0.0)
            continue
        require_bounded(function, lower, upper)
        profile = bend_profile(function, lower, upper, tuple(kinks(function, lower, upper).tolist()))
        smallest = SMALLEST_TOLERANCE * max(1.0, abs(lower), abs(upper))
        tolerances.append(max(error_of_knots(profile, knots_per_period), smallest))
    return tuple(tolerances)


def _widened(lower: Floats, upper: Floats) -> tuple[float, float]:
    low, high = float(lower.min()), float(upper.max())
    margin = MARGIN * max(high - low, abs(low), abs(high))
    return low - margin, high + margin


def _exact_table(unit: Unit) -> KnotTable:
    tables = [function for function in unit.functions if isinstance(function, KnotTable)]
    return tables[0] if len(tables) == 1 else merge(tables, abs(unit.row.bias))


def _tabulate_level(program: Program, level: int, units: list[Unit], lower: Floats, upper: Floats) -> Iterator[Unit]:
    tables: dict[int, KnotTable] = {}
    for group, members in surrogate_groups(units, level).items():
        low, high = _widened(lower[members], upper[members])
        try:
            tolerances = program.tolerances.get(group)
            if tolerances is None:
                tolerances = default_tolerances(group.functions, low, high, program.knots_per_period)
            table = fit(group.functions, low, high, tolerances)
        except UndefinedFunction as fault:
            others = f" and {len(members) - 1} more" if len(members) > 1 else ""
            raise UndefinedFunction(f"{units[members[0]].name}{others}: {fault}") from fault
        tables.update(dict.fromkeys(members, table))
    for position, unit in enumerate(units):
        yield replace(unit, table=tables[position] if position in tables else _exact_table(unit))


def tabulate(program: Program) -> Program:
    """``program`` with a table on every unit.

    Raises `UndefinedFunction` naming the unit whose function cannot be followed.
    """
    network = program.network
    propagation = BoundPropagation(network, program.lower, program.upper)
    has_smooth = any(is_smooth(unit) for unit in network.units)
    units: list[Unit] = list(network.units)
    for level, block in enumerate(level_blocks(network)):
        members: Integers = block.units
        at_level = [network.units[index] for index in members]
        # Without smooth units no range is needed.
        lower, upper = propagation.pre_activations(block) if has_smooth else (np.zeros(0), np.zeros(0))
        done = list(_tabulate_level(program, level, at_level, lower, upper))
        if has_smooth:
            propagation.add_level(block, done, lower, upper)
        for index, unit in zip(members.tolist(), done, strict=True):
            units[index] = unit
    return replace(program, network=replace(network, units=tuple(units)))


def _run(program: Program) -> tuple[Program, bool]:
    return tabulate(program), True


TABULATE = Pass("tabulate", _run, (well_formed, nothing_affine, no_proportional_rows), (tabulated,))
