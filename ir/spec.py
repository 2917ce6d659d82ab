"""The grammar of the IR: what may stand in a network at each stage, as named properties that are checked.

*imported*: what the frontend gives. *canonical*: what the traversal takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.levels import level_blocks
from mn_onnx.ir.network import AffineRow, Floats, KnotTable, Network, Unit
from mn_onnx.ir.proportional import proportional_groups
from mn_onnx.ir.scalar import simplify

# Adjacent pieces of a table agree at their knot up to this many roundings of the largest term.
CONTINUITY_ULPS = 8


class InvalidNetwork(ValueError):
    """A network violates the grammar of its stage; the message lists every violation."""


def _row_faults(row: AffineRow, n_variables: int) -> Iterator[str]:
    if row.columns.dtype != np.int64 or row.weights.dtype != np.float64 or row.columns.shape != row.weights.shape:
        yield "its row needs int64 columns and float64 weights of one length"
        return
    if row.columns.size and (row.columns[0] < 0 or row.columns[-1] >= n_variables or (np.diff(row.columns) <= 0).any()):
        yield f"its row's columns must increase and lie in 0..{n_variables - 1}, the variables before it"
    if not (np.isfinite(row.weights).all() and np.isfinite(row.bias)):
        yield "its row has a weight or bias that is not finite"


def _table_faults(table: KnotTable, n_outputs: int) -> Iterator[str]:
    shape = (n_outputs, table.knots.size + 1)
    if not (table.slopes.shape == table.intercepts.shape == table.errors.shape == shape):
        yield f"its table needs slopes, intercepts and errors of shape {list(shape)}"
        return
    if not all(np.isfinite(array).all() for array in (table.knots, table.slopes, table.intercepts, table.errors)):
        yield "its table has a number that is not finite"
        return
    if (np.diff(table.knots) <= 0).any():
        yield "its knots must be strictly increasing"
    if (table.errors < 0).any():
        yield "its errors must not be negative"
    if continuity_gap(table) > 1.0:
        yield "its table is not continuous at a knot"


def continuity_gap(table: KnotTable) -> float:
    """The largest jump at a knot, in units of what rounding explains (at most 1 for a continuous table)."""
    if not table.knots.size:
        return 0.0
    left = table.slopes[:, :-1] * table.knots + table.intercepts[:, :-1]
    right = table.slopes[:, 1:] * table.knots + table.intercepts[:, 1:]
    terms = np.abs(table.intercepts) + np.abs(table.slopes) * np.maximum(
        np.abs(np.append(table.knots, 0.0)), np.abs(np.insert(table.knots, 0, 0.0))
    )
    allowed = CONTINUITY_ULPS * np.finfo(np.float64).eps * (terms[:, :-1] + terms[:, 1:])
    gap: Floats = np.abs(left - right) / np.maximum(allowed, np.finfo(np.float64).tiny)
    return float(gap.max())


def _unit_faults(unit: Unit, n_variables: int, checked: set[int]) -> Iterator[str]:
    yield from _row_faults(unit.row, n_variables)
    if not unit.functions:
        yield "it has no function"
    tables = [(function, 1) for function in unit.functions if isinstance(function, KnotTable)]
    if unit.table is not None:
        tables.append((unit.table, unit.n_outputs))
    for table, n_outputs in tables:
        # Most units of a network share a few tables.
        if id(table) not in checked:
            yield from _table_faults(table, n_outputs)
            checked.add(id(table))


def well_formed(network: Network) -> list[str]:
    """Rows read earlier variables only; numbers are finite; tables are continuous with increasing knots."""
    checked: set[int] = set()
    faults = [
        f"{unit.name}: {fault}"
        for unit, first in zip(network.units, network.first_variable[:-1].tolist(), strict=True)
        for fault in _unit_faults(unit, first, checked)
    ]
    return faults + [f"{network.output_name}: {fault}" for fault in _row_faults(network.output, network.n_variables)]


def piecewise_linear_recognised(network: Network) -> list[str]:
    """No function that is exactly piecewise linear is left as an expression."""
    return [
        f"{unit.name}: a piecewise-linear function is still an expression"
        for unit in network.units
        if any(isinstance(f, Expression) and isinstance(simplify(f), KnotTable) for f in unit.functions)
    ]


def nothing_affine(network: Network) -> list[str]:
    """Every unit depends on the inputs and none of its outputs is an affine function of its pre-activation."""
    return [
        f"{unit.name}: it is affine and belongs into the rows that read it"
        for unit in network.units
        if not unit.row.columns.size or any(isinstance(f, KnotTable) and not f.knots.size for f in unit.functions)
    ]


def all_used(network: Network) -> list[str]:
    """Every output of every unit is read by a later row."""
    used = np.zeros(network.n_variables, bool)
    for row in (*(unit.row for unit in network.units), network.output):
        used[row.columns] = True
    owners = np.unique(network.variable_unit[network.input_dim :][~used[network.input_dim :]])
    return [f"{network.units[index].name}: one of its outputs is never read" for index in owners]


def no_proportional_rows(network: Network) -> list[str]:
    """No two units of a level have proportional pre-activations: their hyperplanes would coincide or be parallel."""
    faults = []
    for block in level_blocks(network):
        groups = proportional_groups(block.weights)
        for members in (group for group in groups if len(group) > 1):
            names = ", ".join(network.units[block.units[member]].name for member in members)
            faults.append(f"{names}: their pre-activations are proportional")
    return faults


def tabulated(network: Network) -> list[str]:
    """Every unit has a table; the traversal needs nothing else.

    The table of a smooth function may have no knot, if the function is nearly straight on its range.
    """
    return [f"{unit.name}: it has no table" for unit in network.units if unit.table is None]


Property = Callable[[Network], list[str]]

IMPORTED: tuple[Property, ...] = (well_formed,)
CANONICAL: tuple[Property, ...] = (well_formed, nothing_affine, all_used, no_proportional_rows, tabulated)


def verify(network: Network, properties: Iterable[Property], where: str) -> None:
    """Raise `InvalidNetwork` with every violation of ``properties``; ``where`` names the stage or pass."""
    faults = [fault for check in properties for fault in check(network)]
    if faults:
        raise InvalidNetwork(f"the network is invalid {where}:\n  " + "\n  ".join(faults))


__all__ = [
    "CANONICAL", "IMPORTED", "InvalidNetwork", "Property", "all_used", "continuity_gap", "no_proportional_rows",
    "nothing_affine", "piecewise_linear_recognised", "tabulated", "verify", "well_formed",
]  # fmt: skip
