"""Networks with smooth activations: how fine their surrogates are, and what that costs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import UsageError
from mn_onnx.ir.forecast import Forecast, forecast
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import Canonical, canonicalize

Floats = NDArray[np.float64]

DEFAULT_BUDGET = 2_500_000
"""Polygons (segments in two dimensions): about half a minute on two cores."""

TOPOLOGY_BUDGET = 12_000_000
"""Polygons at most, where fewer would not have the network's topology: two minutes on two cores."""

TRUSTED_ANGLE = 14.0
"""Degrees that the gradients of the surrogates may be off in the median for the mesh to have the right topology. That
share of the area where they are off by more than 90, and where handles and pieces of their own arise, falls with it:
measured on a SIREN, 3e-3 at 24 degrees (five handles too many), 4e-5 at 14 (none)."""

FINER_FOR, MOST_EXCESS = 1.5, 2.0
"""Without a budget, surrogates may have this many times the polygons that the coarsest give, and that many times the
usual number: where most polygons are from exact functions, as under an encoding, finer surrogates cost little."""

DEFAULT_KNOTS = 16.0
FEWEST_KNOTS = 3.0

MOST_ROUNDS = 8
AIM, ENOUGH = 0.95, 0.85
"""Of the polygons allowed: what a search for the finest surrogates aims at, and where it stops."""

CLOSE = 1.05
"""Numbers of knots within this factor are not worth another attempt."""

THREAD_SECONDS, POLISHING_THREAD_SECONDS = 2e-5, 1.2e-4
"""Of traversal, bounds and checks for one polygon, and of polishing it; measured on a server of two cores."""

BYTES, POLISHING_BYTES = 800, 2000
"""Of memory at the peak for one polygon, and what polishing adds."""


@dataclass(frozen=True, eq=False)
class Fineness:
    """How finely a smooth network is followed: ``knots_per_period`` (None where a tolerance decides), and the cost.

    ``limit``: the budget, or the usual number of polygons where none was given; the forecast may exceed the latter.
    """

    knots_per_period: float | None
    forecast: Forecast
    limit: float

    def cost(self, threads: int, *, polish: bool = False) -> str:
        """What the extraction is expected to cost on ``threads`` threads, a sentence; with ``polish``, of that too."""
        pieces = self.forecast.pieces
        of_each = THREAD_SECONDS + POLISHING_THREAD_SECONDS * polish
        size = pieces * (BYTES + POLISHING_BYTES * polish) / 1e9
        seconds = max(1.0, pieces * of_each / threads)
        time = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
        fineness = "" if self.knots_per_period is None else f" at {self.knots_per_period:.3g} knots per period"
        excess = f" (beyond {self.limit:,.0f})" if pieces > self.limit else ""
        polishing = " with polishing, which divides them" if polish else ""
        return f"about {pieces:,.0f} polygons{excess}{fineness}: about {time} and {size:.1f} GB{polishing}"


def canonical_within_budget(
    network: Network,
    *,
    lower: Floats,
    upper: Floats,
    level: float,
    surrogate_tol: float | None,
    knots_per_period: float | None,
    budget: float | None,
) -> tuple[Canonical, Fineness | None]:
    """The canonical network, and how finely it follows a smooth one (None for an exact one).

    What is asked for decides: a tolerance, or a number of knots. Without either the surrogates are as fine as
    ``budget`` polygons allow, and no finer than `DEFAULT_KNOTS`. Without a budget this is `DEFAULT_BUDGET`, or somewhat
    more where finer surrogates cost little (`FINER_FOR`); where the topology could not be trusted then, they are as
    fine as that takes, up to `TOPOLOGY_BUDGET`.

    Raises `UsageError` with the cost if what is asked for, or the coarsest surrogates, take more polygons than
    ``budget``; and as `canonicalize`.
    """
    by_budget = surrogate_tol is None and knots_per_period is None
    without_budget = DEFAULT_BUDGET if by_budget or surrogate_tol is not None else np.inf
    limit = without_budget if budget is None else budget

    def attempt(knots: float | None) -> tuple[Canonical, Fineness | None]:
        canonical = canonicalize(
            network, lower=lower, upper=upper, level=level, surrogate_tol=surrogate_tol, knots_per_period=knots
        )
        if canonical.is_exact or canonical.empty_reason:
            return canonical, None
        return canonical, Fineness(knots, forecast(canonical.network, lower, upper), limit)

    if not by_budget:
        canonical, fineness = attempt(knots_per_period)
        if fineness is not None and fineness.forecast.pieces > limit:
            raise UsageError(
                f"this would give {fineness.cost(1)} on one thread; the budget is {limit:,.0f} polygons: "
                f"give --budget {_rounded_up(fineness.forecast.pieces)} to have it all the same, or leave out "
                "--surrogate-tol and --knots-per-period for the finest surrogates within the budget"
            )
        return canonical, fineness
    canonical, fineness = attempt(DEFAULT_KNOTS)
    if fineness is None or fineness.forecast.pieces <= limit or lower.size == 1:
        return canonical, fineness
    coarsest = attempt(FEWEST_KNOTS)
    if coarsest[1] is None:
        return coarsest
    allowed = limit
    if budget is None:
        allowed = min(max(limit, FINER_FOR * coarsest[1].forecast.pieces), MOST_EXCESS * limit)
    canonical, fineness = _finest(attempt, allowed, coarsest, DEFAULT_KNOTS, lower.size)
    if budget is not None and fineness is not None and fineness.forecast.pieces > budget:
        raise UsageError(
            f"even the coarsest surrogates give {fineness.cost(1)} on one thread; "
            f"give --budget {_rounded_up(fineness.forecast.pieces)}, or choose a smaller box"
        )
    for _ in range(MOST_ROUNDS if budget is None else 0):
        knots = None if fineness is None else fineness.knots_per_period
        if fineness is None or knots is None or fineness.forecast.angle <= TRUSTED_ANGLE or knots >= DEFAULT_KNOTS:
            break
        # Gradients are off in proportion to the distance of knots.
        ratio = math.tan(math.radians(fineness.forecast.angle)) / math.tan(math.radians(TRUSTED_ANGLE))
        finer = _finest(attempt, TOPOLOGY_BUDGET, (canonical, fineness), min(DEFAULT_KNOTS, ratio * knots), lower.size)
        if finer[0] is canonical:
            break
        canonical, fineness = finer
    return canonical, fineness


def _finest(
    attempt: Callable[[float], tuple[Canonical, Fineness | None]],
    limit: float,
    coarsest: tuple[Canonical, Fineness | None],
    most_knots: float,
    dimension: int,
) -> tuple[Canonical, Fineness | None]:
    """The finest surrogates of at most ``most_knots`` and ``limit`` pieces, or else ``coarsest``.

    Lines on the surface are those of knots that exact functions have, and others in proportion to the knots per period;
    pieces go with their square in three dimensions. So its root is interpolated.
    """
    exponent = 1 / (dimension - 1)
    goal = (AIM * limit) ** exponent
    best, knots = coarsest, most_knots
    low, root_low, high, root_high = FEWEST_KNOTS, 0.0, np.inf, np.inf
    if coarsest[1] is not None:
        low, root_low = coarsest[1].knots_per_period or low, coarsest[1].forecast.pieces ** exponent
    for _ in range(MOST_ROUNDS):
        found = attempt(knots)
        if found[1] is None:
            return found
        root = found[1].forecast.pieces ** exponent
        if found[1].forecast.pieces <= limit:
            best, low, root_low = found, knots, root
            if knots >= most_knots or found[1].forecast.pieces >= ENOUGH * limit:
                break
        else:
            high, root_high = knots, root
        if high < CLOSE * low:
            break
        share = (goal - root_low) / (root_high - root_low) if root_low < root_high else 0.5
        knots = low + (high - low) * min(max(share, 0.2), 0.9)
    return best


def _rounded_up(number: float) -> int:
    unit: int = 10 ** max(0, int(math.log10(max(number, 1.0))) - 1)
    return math.ceil(1.1 * number / unit) * unit
