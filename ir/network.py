"""The canonical piecewise-linear network: scalar units over an input box.

A network is a DAG of scalar *units*. Unit ``g`` has an affine *pre-activation*

    t_g = bias + sum_j weights[j] * v[columns[j]]

over *variables* ``v``: the ``input_dim`` coordinates first, then the outputs of earlier units in order. The unit maps
``t_g`` through one scalar function per output. The network's value is one more affine row.

At the *imported* stage a scalar function may be a smooth `Expression`; at the *canonical* stage every unit carries a
`table` (merged knots; one slope and intercept per output and interval).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.expression import Expression

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class AffineRow:
    """``bias + weights . v[columns]``.

    ``columns``: int64 [n], strictly increasing variable indices; ``weights``: float64 [n]; ``bias``: float.
    """

    columns: Integers
    weights: Floats
    bias: float


@dataclass(frozen=True, eq=False)
class KnotTable:
    """A continuous piecewise-linear function of one scalar with ``o`` outputs and ``m`` knots.

    ``knots``: float64 [m], strictly increasing. On interval ``i`` (between knots ``i-1`` and ``i``) output ``k`` is
    ``slopes[k, i] * t + intercepts[k, i]``; ``slopes`` and ``intercepts`` are float64 [o, m + 1].
    ``errors``: float64 [o, m + 1], a proved bound on ``|true - table|`` per output and interval; zero where exact. It
    holds for the arguments that occur on the box the network was canonicalised for.
    """

    knots: Floats
    slopes: Floats
    intercepts: Floats
    errors: Floats

    @classmethod
    def exact(
        cls, knots: Sequence[float], slopes: Sequence[Sequence[float]], intercepts: Sequence[Sequence[float]]
    ) -> KnotTable:
        """A table without error from plain sequences."""
        slope_array = np.atleast_2d(np.asarray(slopes, np.float64))
        return cls(
            np.asarray(knots, np.float64).reshape(-1),
            slope_array,
            np.atleast_2d(np.asarray(intercepts, np.float64)),
            np.zeros_like(slope_array),
        )

    @property
    def n_outputs(self) -> int:
        return int(self.slopes.shape[0])

    def evaluate(self, t: Floats) -> Floats:
        """Values [o, *t.shape] at ``t``; a knot belongs to the interval on its right."""
        interval = np.searchsorted(self.knots, t, side="right")
        return self.slopes[:, interval] * t + self.intercepts[:, interval]


ScalarFunction = KnotTable | Expression


@dataclass(frozen=True, eq=False)
class Unit:
    """One scalar unit: its pre-activation row and one scalar function per output.

    ``functions`` are the true functions (each `KnotTable` among them has one output); ``table`` is what the traversal
    uses, and is None until the surrogate pass has run. ``name`` is the ONNX node and feature the unit came from.
    """

    row: AffineRow
    functions: tuple[ScalarFunction, ...]
    name: str
    table: KnotTable | None = None

    @property
    def n_outputs(self) -> int:
        return len(self.functions)


@dataclass(frozen=True, eq=False)
class Network:
    """Units in topological order, and the affine output row ``f``. The level set is ``f = 0``."""

    input_dim: int
    units: tuple[Unit, ...]
    output: AffineRow
    output_name: str = "output"
    metadata: dict[str, str] = field(default_factory=dict)

    @cached_property
    def first_variable(self) -> Integers:
        """int64 [n_units + 1]: the first variable index of every unit's outputs, then the number of variables."""
        counts = np.fromiter((unit.n_outputs for unit in self.units), np.int64, len(self.units))
        return self.input_dim + np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])

    @property
    def n_variables(self) -> int:
        return int(self.first_variable[-1])

    @cached_property
    def variable_unit(self) -> Integers:
        """int64 [n_variables]: the unit a variable belongs to, -1 for inputs."""
        counts = np.diff(self.first_variable)
        return np.concatenate([np.full(self.input_dim, -1), np.repeat(np.arange(len(self.units)), counts)])

    @cached_property
    def unit_level(self) -> Integers:
        """int64 [n_units]: 0 for units over the inputs alone, else one more than the deepest unit it reads."""
        level = np.zeros(len(self.units), np.int64)
        for index, unit in enumerate(self.units):
            sources = self.variable_unit[unit.row.columns]
            sources = sources[sources >= 0]
            if sources.size:
                level[index] = level[sources].max() + 1
        return level
