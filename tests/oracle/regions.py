"""Enumeration of every activation region of a tiny network over a box, in exact rational arithmetic."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

from mn_onnx.ir.network import AffineRow, KnotTable, Network
from oracle.polytope import Affine, Polytope, combine


@dataclass(frozen=True)
class Region:
    """A full-dimensional cell where every unit stays in one interval of its table (``states``) and ``f`` is affine."""

    states: tuple[int, ...]
    polytope: Polytope
    value: Affine


def activation_regions(network: Network, lower: Sequence[float], upper: Sequence[float]) -> Iterator[Region]:
    """All regions of ``network`` in the box, in lexicographic order of their states.

    Every unit splits, whether or not it has an influence on ``f``. A unit that sits on a knot over a whole region is
    counted in the interval on the knot's right.

    Raises ``ValueError`` for a unit without a table.
    """
    dimension = network.input_dim
    coordinates = [
        Affine(tuple(Fraction(int(axis == other)) for other in range(dimension)), Fraction(0))
        for axis in range(dimension)
    ]
    yield from _descend(network, Polytope.box(lower, upper), coordinates, ())


def _descend(
    network: Network, polytope: Polytope, variables: list[Affine], states: tuple[int, ...]
) -> Iterator[Region]:
    if len(states) == len(network.units):
        yield Region(states, polytope, _row(network.output, variables, network.input_dim))
        return
    unit = network.units[len(states)]
    if unit.table is None:
        raise ValueError(f"unit {unit.name!r} has no table; the oracle reads canonical networks")
    activation = _row(unit.row, variables, network.input_dim)
    for state, part in _intervals(unit.table, activation, polytope):
        outputs = [
            activation.scaled(Fraction(float(slope)), Fraction(float(intercept)))
            for slope, intercept in zip(unit.table.slopes[:, state], unit.table.intercepts[:, state], strict=True)
        ]
        yield from _descend(network, part, variables + outputs, (*states, state))


def _row(row: AffineRow, variables: list[Affine], dimension: int) -> Affine:
    terms = [
        (Fraction(float(weight)), variables[column]) for column, weight in zip(row.columns, row.weights, strict=True)
    ]
    return combine(terms, Fraction(float(row.bias)), dimension)


def _intervals(table: KnotTable, activation: Affine, polytope: Polytope) -> Iterator[tuple[int, Polytope]]:
    """The parts of ``polytope`` per interval of ``table`` that ``activation`` reaches."""
    for state, knot in enumerate(table.knots):
        below, above = polytope.split(activation.scaled(Fraction(1), -Fraction(float(knot))))
        if below is not None:
            yield state, below
        if above is None:
            return
        polytope = above
    yield len(table.knots), polytope
