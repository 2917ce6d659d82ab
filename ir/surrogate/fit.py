"""Piecewise-linear surrogates of smooth scalar functions, with proved errors.

Knots stand at kinks and, between them, at equal amounts of ``integral of sqrt(|f''|)``: to leading order that makes the
error the same on every interval, which no other choice of as many knots betters (de Boor, "A Practical Guide to
Splines", ch. XII). So flat tails cost nothing: Softplus with a large beta gets its few knots where it bends.

Values at the knots are moved off the function by half the sag of the adjacent chords, which halves the error of
interpolation. Continuity is by construction: every interval's line passes through the same two knot values; rounding of
slope and intercept leaves a jump of at most 8 units in the last place of the largest term.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats, KnotTable, ScalarFunction
from mn_onnx.ir.scalar import UndefinedFunction, evaluate
from mn_onnx.ir.scalar.deviation import deviation
from mn_onnx.ir.surrogate.curvature import BendProfile, bend_profile, kinks, require_bounded
from mn_onnx.ir.tables import interval_indices

MOST_KNOTS = 1 << 16
BALANCE_ROUNDS = 4
MOST_ATTEMPTS = 16
# At first only the intervals that need it become finer; but that moves all others a little.
LOCAL_ATTEMPTS = 3
# Errors above the tolerance are followed by a little more than the knots that the leading order asks for.
OVERSHOOT = 1.04
# A bend of a whole number of shares, up to rounding, needs as many intervals and not one more.
COUNT_ROUNDING = 1e-9


def error_of_knots(profile: BendProfile, knots_per_period: float) -> float:
    """The error that ``knots_per_period`` knots on every two lobes of curvature give the function of ``profile``.

    A sine has two lobes per period; Softplus has one in all.
    """
    intervals = max(1.0, knots_per_period * profile.lobes / 2)
    return (profile.total / intervals) ** 2 / 16


def fit(
    functions: Sequence[ScalarFunction],
    lower: float,
    upper: float,
    tolerances: Sequence[float],
    *,
    most_excess: float = 1.0,
) -> KnotTable:
    """One table for all ``functions`` on ``[lower, upper]``, output ``k`` within ``tolerances[k]`` (positive).

    Errors up to ``most_excess`` times the tolerances will do; the knots are fewer attempts' work then.
    Knots are shared: they follow, at every place, the function that bends most beside its tolerance, and include all
    knots of functions that are tables themselves. Outside the range the outer pieces continue; errors are proved for
    the range. Raises `UndefinedFunction` if a function jumps, is unbounded or undefined on the range, or cannot be
    followed within its tolerance.
    """
    smooth = [(index, f) for index, f in enumerate(functions) if isinstance(f, Expression)]
    fixed = [f.knots[(f.knots > lower) & (f.knots < upper)] for f in functions if isinstance(f, KnotTable)]
    if upper <= lower:
        return _constant_table(functions, lower)
    for _, function in smooth:
        require_bounded(function, lower, upper)
        fixed.append(kinks(function, lower, upper))
    corners = np.unique(np.concatenate([np.zeros(0), *fixed]))
    profiles = [bend_profile(function, lower, upper, tuple(corners.tolist())) for _, function in smooth]
    shares = np.array([4 * np.sqrt(tolerances[index]) for index, _ in smooth])
    density = _BendDensity(profiles, shares)
    for attempt in range(MOST_ATTEMPTS):
        nodes = density.place_nodes(np.concatenate([[lower], corners, [upper]]))
        table = _tabulate(functions, nodes)
        excess = np.array([table.errors[index] / tolerances[index] for index, _ in smooth])
        if excess.max() <= most_excess:
            return table
        if not np.isfinite(excess).all() or nodes.size > MOST_KNOTS:
            break
        density.raise_where(nodes, excess.max(axis=0), everywhere=attempt >= LOCAL_ATTEMPTS)
    index = smooth[int(np.argmax(excess.max(axis=1)))][0]
    raise UndefinedFunction(
        f"its function cannot be followed within {tolerances[index]:.3g} on its range [{lower:.6g}, {upper:.6g}] "
        f"over the box: with {nodes.size} knots the proved error is {table.errors[index].max():.3g}"
    )


class _BendDensity:
    """Intervals wanted per unit of length: the bend of the function that bends most, in shares of its tolerance."""

    def __init__(self, profiles: Sequence[BendProfile], shares: Floats) -> None:
        self._edges = np.unique(np.concatenate([profile.edges for profile in profiles]))
        middles = 0.5 * (self._edges[:-1] + self._edges[1:])
        self._density = np.zeros(middles.size)
        for profile, share in zip(profiles, shares, strict=True):
            cell = np.clip(np.searchsorted(profile.edges, middles, side="right") - 1, 0, profile.bend.size - 1)
            wanted = profile.bend[cell] / np.diff(profile.edges)[cell] / share
            self._density = np.maximum(self._density, wanted)

    def place_nodes(self, stops: Floats) -> Floats:
        """Nodes at all ``stops``, and between them at equal integrals of the density, each at most one."""
        bend = np.concatenate([[0.0], np.cumsum(self._density * np.diff(self._edges))])
        at_stops = np.interp(stops, self._edges, bend)
        nodes = [stops]
        for start, stop in pairwise(at_stops.tolist()):
            count = min(math.ceil((stop - start) * (1 - COUNT_ROUNDING)), MOST_KNOTS)
            nodes.append(np.interp(start + (stop - start) * np.arange(1, count) / max(count, 1), bend, self._edges))
        return np.unique(np.concatenate(nodes))

    def raise_where(self, nodes: Floats, excess: Floats, *, everywhere: bool) -> None:
        """Make intervals between ``nodes`` finer whose error exceeds the tolerance by the factor ``excess``, or all."""
        if everywhere:
            excess = np.full(excess.size, excess.max())
        middles = 0.5 * (self._edges[:-1] + self._edges[1:])
        interval = np.clip(np.searchsorted(nodes, middles, side="right") - 1, 0, excess.size - 1)
        self._density *= np.where(excess > 1, OVERSHOOT * np.sqrt(np.maximum(excess, 1.0)), 1.0)[interval]


def _tabulate(functions: Sequence[ScalarFunction], nodes: Floats) -> KnotTable:
    """The table over ``nodes``, of which the inner ones are its knots, with proved errors."""
    rows = [
        _copy(function, nodes) if isinstance(function, KnotTable) else _follow(function, nodes)
        for function in functions
    ]
    slopes, intercepts, errors = (np.array(part) for part in zip(*rows, strict=True))
    return KnotTable(nodes[1:-1], slopes, intercepts, errors)


def _copy(table: KnotTable, nodes: Floats) -> tuple[Floats, Floats, Floats]:
    first = int(np.searchsorted(table.knots, nodes[0], side="right"))
    index = np.maximum(interval_indices(table, nodes[1:-1]), first)
    return table.slopes[0, index], table.intercepts[0, index], table.errors[0, index]


def _lines(nodes: Floats, values: Floats) -> tuple[Floats, Floats]:
    slopes = np.diff(values) / np.diff(nodes)
    # From the nearer end of each interval to zero, so that the intercept's rounding stays small.
    left_is_nearer = np.abs(nodes[:-1]) <= np.abs(nodes[1:])
    anchor, value = np.where(left_is_nearer, nodes[:-1], nodes[1:]), np.where(left_is_nearer, values[:-1], values[1:])
    return slopes, value - slopes * anchor


def _sag(expression: Expression, nodes: Floats, slopes: Floats, intercepts: Floats) -> Floats:
    """The middle of the deviation's range on each interval, from samples; balances the lines, proves nothing."""
    inside = nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(0.0, 1.0, 17)
    deviations = evaluate(expression, inside) - (slopes[:, None] * inside + intercepts[:, None])
    middle: Floats = 0.5 * (deviations.max(axis=1) + deviations.min(axis=1))
    return middle


def _follow(expression: Expression, nodes: Floats) -> tuple[Floats, Floats, Floats]:
    """Slopes, intercepts and proved errors of the balanced surrogate over ``nodes``."""
    values = evaluate(expression, nodes)
    best: tuple[Floats, Floats, float] | None = None
    for _ in range(BALANCE_ROUNDS):
        slopes, intercepts = _lines(nodes, values)
        middle = _sag(expression, nodes, slopes, intercepts)
        # At a node the mean of its two intervals' offsets; a step of this size never overshoots equal neighbours.
        step = np.concatenate([middle[:1], 0.5 * (middle[:-1] + middle[1:]), middle[-1:]])
        worst = _worst_sample(expression, nodes, slopes, intercepts)
        if best is None or worst < best[2]:
            best = (slopes, intercepts, worst)
        values = values + step
    assert best is not None
    slopes, intercepts, _ = best
    sure, _ = deviation(expression, nodes[:-1], nodes[1:], slopes, intercepts)
    return slopes, intercepts, sure.magnitude


def _worst_sample(expression: Expression, nodes: Floats, slopes: Floats, intercepts: Floats) -> float:
    inside = nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(0.0, 1.0, 17)
    return float(np.abs(evaluate(expression, inside) - (slopes[:, None] * inside + intercepts[:, None])).max())


def _constant_table(functions: Sequence[ScalarFunction], t: float) -> KnotTable:
    """A table for a range of one point."""
    values = np.array([
        f.evaluate(np.array(t))[0] if isinstance(f, KnotTable) else evaluate(f, np.array(t)) for f in functions
    ])  # fmt: skip
    shape = (len(functions), 1)
    return KnotTable(np.zeros(0), np.zeros(shape), values.reshape(shape), np.zeros(shape))
