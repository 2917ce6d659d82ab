"""Networks with smooth activations: how fine their surrogates are, what that costs, what is proved of the surface."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import UsageError
from mn_onnx.extract.face_errors import surface_errors
from mn_onnx.extract.polish import polish
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import gradient
from mn_onnx.ir.forecast import Forecast, forecast
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import Canonical, canonicalize

Floats = NDArray[np.float64]

DEFAULT_BUDGET = 2_500_000
"""Polygons (segments in two dimensions): about a minute of traversal on two cores."""

DEFAULT_KNOTS = 16.0
FEWEST_KNOTS = 2.0
MOST_ROUNDS = 4

THREAD_SECONDS = 1e-4
"""Of traversal, bounds and checks for one polygon; measured on a server of two cores."""

BYTES = 1500
"""Of memory at the peak for one polygon."""

SHALLOW = 0.1
"""Below this part of the median slope, what an error means for the place of the surface is not foretold."""


VAGUE = 0.05
"""A displacement bound above this part of the largest side of the box says nothing of where the surface is."""

ANGLE_SAMPLES = 1 << 14

NOT_CERTIFIED: Mapping[str, None] = dict.fromkeys(
    (
        "surface_eps",
        "surface_eps_median",
        "displacement",
        "displacement_median",
        "shallow_polygons",
        "vague_polygons",
        "gradient_angle_median",
        "turned_share",
    )
)
"""The entries of `certified` where there is nothing to prove."""


@dataclass(frozen=True, eq=False)
class Fineness:
    """How finely a smooth network is followed: ``knots_per_period`` (None where a tolerance decides), and the cost."""

    knots_per_period: float | None
    forecast: Forecast

    def cost(self, threads: int) -> str:
        """What the extraction is expected to cost on ``threads`` threads, a sentence."""
        pieces = self.forecast.pieces
        seconds = max(1.0, pieces * THREAD_SECONDS / threads)
        time = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
        fineness = "" if self.knots_per_period is None else f" at {self.knots_per_period:.3g} knots per period"
        return f"about {pieces:,.0f} polygons{fineness}: about {time} and {pieces * BYTES / 1e9:.1f} GB"


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
    ``budget`` polygons allow, and no finer than `DEFAULT_KNOTS`.

    Raises `UsageError` with the cost if what is asked for, or the coarsest surrogates, take more polygons than
    ``budget``; and as `canonicalize`.
    """

    def attempt(knots: float | None) -> tuple[Canonical, Fineness | None]:
        canonical = canonicalize(
            network, lower=lower, upper=upper, level=level, surrogate_tol=surrogate_tol, knots_per_period=knots
        )
        if canonical.is_exact or canonical.empty_reason:
            return canonical, None
        return canonical, Fineness(knots, forecast(canonical.network, lower, upper))

    if surrogate_tol is not None or knots_per_period is not None:
        canonical, fineness = attempt(knots_per_period)
        limit = budget if budget is not None else np.inf if surrogate_tol is None else DEFAULT_BUDGET
        if fineness is not None and fineness.forecast.pieces > limit:
            raise UsageError(
                f"this would give {fineness.cost(1)} on one thread, more than the budget of {limit:,.0f} polygons; "
                f"give --budget {_rounded_up(fineness.forecast.pieces)} to have it all the same, or leave out "
                "--surrogate-tol and --knots-per-period for the finest surrogates within the budget"
            )
        return canonical, fineness
    limit = DEFAULT_BUDGET if budget is None else budget
    knots = DEFAULT_KNOTS
    canonical, fineness = attempt(knots)
    for _ in range(MOST_ROUNDS):
        if fineness is None or fineness.forecast.pieces <= limit or knots <= FEWEST_KNOTS or lower.size == 1:
            break
        # Polygons go with the square of the knots at most, segments with the knots.
        share = 0.95 * limit / fineness.forecast.pieces
        knots = max(FEWEST_KNOTS, knots * share ** (1 / (lower.size - 1)))
        canonical, fineness = attempt(knots)
    if budget is not None and fineness is not None and fineness.forecast.pieces > budget and knots <= FEWEST_KNOTS:
        raise UsageError(
            f"even the coarsest surrogates give {fineness.cost(1)} on one thread, "
            f"more than the budget of {budget:,.0f}; "
            f"give --budget {_rounded_up(fineness.forecast.pieces)}, or choose a smaller box"
        )
    return canonical, fineness


def _rounded_up(number: float) -> int:
    unit: int = 10 ** max(0, int(math.log10(max(number, 1.0))) - 1)
    return math.ceil(1.1 * number / unit) * unit


def certified(surface: Surface, canonical: Canonical, *, threads: int | None = None) -> tuple[Surface, dict[str, Any]]:
    """The surface of a smooth network with the proved error of each polygon, and what the report says of them.

    ``attributes["eps"]`` are these errors, ``attributes["displacement"]`` how far the true level set may be from each
    polygon: eps over the slope there, to first order in eps. Where the slope is small this says little.
    """
    side = float((canonical.upper - canonical.lower).max())
    errors = surface_errors(canonical.network, surface, canonical.lower, canonical.upper, threads=threads)
    errors = np.minimum(errors, canonical.surrogate_eps)
    slopes = np.sqrt((surface.gradients**2).sum(axis=1))
    steep = slopes > SHALLOW * np.median(slopes)
    displacement = errors / np.maximum(slopes, np.finfo(np.float64).tiny)
    entries = {
        "surface_eps": float(errors.max()),
        "surface_eps_median": float(np.median(errors)),
        "displacement": float(displacement[steep].max()),
        "displacement_median": float(np.median(displacement)),
        "shallow_polygons": int(np.count_nonzero(~steep)),
        "vague_polygons": int(np.count_nonzero(displacement > VAGUE * side)),
        **_gradient_angles(surface, canonical.network),
    }
    attributes = {**surface.attributes, "eps": errors, "displacement": displacement}
    return replace(surface, errors=errors, attributes=attributes), entries


def _gradient_angles(surface: Surface, network: Network) -> dict[str, float]:
    """How far the gradients of the surrogates are from the true ones, at random points of the faces."""
    points, polygons = sample_surface(surface, ANGLE_SAMPLES)
    true, found = gradient(network, points, true_functions=True), surface.gradients[polygons]
    lengths = np.sqrt((true**2).sum(axis=1) * (found**2).sum(axis=1))
    cosines = np.einsum("ij,ij->i", true, found) / np.where(lengths > 0, lengths, 1.0)
    return {
        "gradient_angle_median": float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))),
        "turned_share": float((cosines <= 0).mean()),
    }


def topology_notes(certificate: Mapping[str, Any]) -> list[str]:
    """What is to be said of the topology of a smooth network's mesh, a sentence or none."""
    share = certificate["turned_share"]
    if not share:
        return []
    return [
        f"on about {share:.2g} of the area the gradient of the surrogates is more than 90 degrees from that of the "
        "network: there the topology may be that of the surrogates only, with handles and pieces the network does not "
        "have; take finer surrogates, by a larger --budget or --knots-per-period"
    ]


def polished(surface: Surface, canonical: Canonical, *, threads: int | None = None) -> tuple[Surface, dict[str, Any]]:
    """The surface, one of `certified`, moved onto the level set of the true network, and what that did."""
    moved, result = polish(surface, canonical.network, canonical.lower, canonical.upper, threads=threads)
    return moved, asdict(result)
