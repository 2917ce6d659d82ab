"""How much a function bends, and where: what the number and the places of a surrogate's knots follow from."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats
from mn_onnx.ir.scalar import UndefinedFunction, breakpoints, discontinuities, evaluate, jet
from mn_onnx.ir.scalar.derivative import derivative
from mn_onnx.ir.scalar.kinks import halve

FIRST_CELLS = 32
MOST_CELLS = 1 << 16
# Cells of a bend profile are halved until each holds at most this part of all bending.
FINEST_SHARE = 1.0 / 256
MOST_ROUNDS = 40
# A change of slope below this fraction of the function's steepness is no kink worth a knot: its error is far smaller
# than that of the curves beside it.
NEGLIGIBLE_KINK = 1e-7


@dataclass(frozen=True, eq=False)
class BendProfile:
    """How a function bends over ``edges`` [c + 1]: ``bend`` [c] holds ``width * sqrt(sup |f''|)`` of every cell.

    A chord across bend ``B`` misses the function by at most ``B**2 / 8``, at its best offset by half of that.
    ``lobes``: the number of stretches between changes of the curvature's sign.
    """

    edges: Floats
    bend: Floats
    lobes: int

    @property
    def total(self) -> float:
        return float(self.bend.sum())


@functools.lru_cache(maxsize=1024)
def kinks(expression: Expression, lower: float, upper: float) -> Floats:
    """The points inside ``(lower, upper)`` where the slope of ``expression`` jumps noticeably."""
    candidates = breakpoints(expression, lower, upper)
    if not candidates.size:
        return candidates
    slope = derivative(expression)
    reach = 1e-9 * np.maximum(np.abs(candidates), upper - lower)
    left, right = evaluate(slope, candidates - reach), evaluate(slope, candidates + reach)
    steepness = np.abs(evaluate(slope, np.linspace(lower, upper, 257)))
    typical = max(float(np.median(steepness[np.isfinite(steepness)], axis=0)) if np.isfinite(steepness).any() else 0.0,
                  float(np.nanmax(np.abs(np.concatenate([left, right])))))  # fmt: skip
    with np.errstate(invalid="ignore"):
        smooth = np.abs(left - right) <= NEGLIGIBLE_KINK * typical
    return candidates[~smooth]


@functools.lru_cache(maxsize=1024)
def bend_profile(expression: Expression, lower: float, upper: float, at: tuple[float, ...]) -> BendProfile:
    """The bend of ``expression`` between the points ``at`` on ``[lower, upper]``.

    Raises `UndefinedFunction` where it is unbounded or undefined.
    """
    edges = np.unique(np.concatenate([np.linspace(lower, upper, FIRST_CELLS + 1), np.asarray(at, np.float64)]))
    low, high = edges[:-1], edges[1:]
    bend = _bend(expression, low, high)
    for _ in range(MOST_ROUNDS):
        share = max(bend.sum(), 1e-300) * FINEST_SHARE
        coarse = ~(bend <= share)
        if not coarse.any() or low.size > MOST_CELLS:
            break
        finer_low, finer_high = halve(low[coarse], high[coarse])
        low = np.concatenate([low[~coarse], finer_low])
        high = np.concatenate([high[~coarse], finer_high])
        bend = np.concatenate([bend[~coarse], _bend(expression, finer_low, finer_high)])
    order = np.argsort(low, kind="stable")
    low, high, bend = low[order], high[order], bend[order]
    bend = np.where(np.isfinite(bend), bend, 0.0)
    return BendProfile(np.append(low, high[-1]), bend, _lobes(expression, 0.5 * (low + high)))


def _bend(expression: Expression, low: Floats, high: Floats) -> Floats:
    enclosure = jet(expression, low, high)
    width = high - low
    with np.errstate(invalid="ignore", over="ignore"):
        by_curvature = width * np.sqrt(enclosure.curvature.magnitude)
        # Across a kink or a vertical tangent: what a chord misses at most by slope, or by value.
        by_slope = np.sqrt(2 * width * enclosure.slope.width)
        by_value = np.sqrt(8 * enclosure.value.width)
        bend = np.fmin(np.fmin(by_curvature, by_slope), by_value)
    return np.where(np.isnan(bend), np.inf, bend)


def _lobes(expression: Expression, t: Floats) -> int:
    curvature = jet(expression, t, t).curvature
    signs = np.where(curvature.lower > 0, 1, np.where(curvature.upper < 0, -1, 0))
    signs = signs[signs != 0]
    return int(1 + np.count_nonzero(np.diff(signs))) if signs.size else 0


@functools.lru_cache(maxsize=1024)
def require_bounded(expression: Expression, lower: float, upper: float) -> None:
    """Raise `UndefinedFunction` if ``expression`` jumps, is unbounded or undefined on ``[lower, upper]``."""
    jumps = discontinuities(expression, lower, upper)
    if jumps:
        where = ", ".join(f"{jump:.6g}" for jump in jumps[:4]) + (", ..." if len(jumps) > 4 else "")
        raise UndefinedFunction(
            f"its function jumps or is undefined at pre-activation {where}, inside its range "
            f"[{lower:.6g}, {upper:.6g}] over the box"
        )
