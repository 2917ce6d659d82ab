"""Draw how the error of a level set falls with the number of knots of its surrogates.

pip install ".[bench]"
python models/circle_knots.py models/circle_pe2_d2_w4.onnx models/circle_knots.png

The experiment of section 5.7 of Stippel et al., "Marching Neurons", ACM TOG 44(6), 2025, with two ways to place knots:
equally spaced ones with chords between them, and ours (`mn_onnx.ir.surrogate.fit`).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

import mn_onnx
from mn_onnx.extract.planar.curve import Curve
from mn_onnx.extract.planar.prism import extract_curve
from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.evaluate import evaluate, gradient
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, Network, Unit
from mn_onnx.ir.scalar import evaluate as evaluate_function

Floats = NDArray[np.float64]

KNOTS_PER_PERIOD = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
SHOWN = (2, 4, 16)
SAMPLES = 33
COLOURS = {"ours": "#1b6ca8", "equally spaced": "#c8553d"}
TRUE_COLOUR = "#cccccc"
DETAIL = (0.2, 0.62, 0.2, 0.62)


@dataclass(frozen=True)
class Errors:
    """Of one curve: knots of a coordinate's encoding, distance to the true level set, proved bound of |f_true - f|."""

    knots: int
    largest: float
    mean: float
    certified: float


def with_equal_knots(network: Network, lower: Floats, upper: Floats) -> Network:
    """``network`` with as many knots as it has, equally spaced, and values on the functions at the knots."""
    bounds = unit_bounds(network, lower, upper)
    return replace(
        network,
        units=tuple(_with_equal_knots(unit, *ends) for unit, *ends in zip(network.units, *bounds, strict=True)),
    )


def _with_equal_knots(unit: Unit, low: float, high: float) -> Unit:
    functions = [function for function in unit.functions if isinstance(function, Expression)]
    if unit.table is None or not functions:
        return unit
    nodes = np.linspace(low, high, unit.table.knots.size + 2)
    values = np.array([evaluate_function(function, nodes) for function in functions])
    slopes = np.diff(values) / np.diff(nodes)
    table = KnotTable(nodes[1:-1], slopes, values[:, :-1] - slopes * nodes[:-1], np.zeros_like(slopes))
    return replace(unit, table=table)


def distances(network: Network, curve: Curve) -> tuple[float, float]:
    """The largest and mean distance to the true level set along ``curve``, to first order: |f| over its slope."""
    ends = curve.vertices[curve.segments]
    steps = (np.arange(SAMPLES) + 0.5)[:, None, None] / SAMPLES
    points = (ends[:, 0] + steps * (ends[:, 1] - ends[:, 0])).reshape(-1, 2)
    slopes = np.sqrt((gradient(network, points, true_functions=True) ** 2).sum(axis=1))
    away = np.abs(evaluate(network, points, true_functions=True)) / slopes
    return float(away.max()), float(np.average(away, weights=np.tile(curve.lengths, SAMPLES)))


def measure(path: str, knots_per_period: float) -> dict[str, tuple[Curve, Errors]]:
    """Curve and errors of both ways to place knots."""
    model = mn_onnx.load(path, knots_per_period=knots_per_period)
    equal = with_equal_knots(model.network, model.lower, model.upper)
    found = {}
    for name, network, certified in (("ours", model.network, model.surrogate_eps), ("equally spaced", equal, np.nan)):
        curve = extract_curve(network, model.lower, model.upper).curve
        knots = max(unit.table.knots.size for unit in network.units if unit.table is not None)
        found[name] = curve, Errors(knots, *distances(model.network, curve), certified)
    return found


def draw_errors(axes: Axes, series: dict[str, list[Errors]]) -> None:
    """Largest and mean distance, and the proved bound, against the knots of one coordinate."""
    for name, errors in series.items():
        knots = [entry.knots for entry in errors]
        largest, mean = [entry.largest for entry in errors], [entry.mean for entry in errors]
        axes.loglog(knots, largest, "o-", ms=4, color=COLOURS[name], label=f"{name}: largest")
        axes.loglog(knots, mean, "o:", ms=3, color=COLOURS[name], label=f"{name}: mean")
    ours = series["ours"]
    axes.loglog(
        [e.knots for e in ours], [e.certified for e in ours], "--", color="#777777", label="ours: proved bound of |f|"
    )
    ends = np.array([ours[0].knots, ours[-1].knots])
    axes.loglog(ends, ours[-1].mean / 3 * (ends[-1] / ends) ** 2, color="#bbbbbb", lw=1, label="second order")
    axes.set_xlabel("knots per coordinate")
    axes.set_ylabel("distance from the true level set")
    axes.legend(frameon=False, fontsize=8)


def draw_curves(axes: Axes, path: str, curves: dict[int, Curve]) -> None:
    """A part of the level sets with few knots, over the true one."""
    model = mn_onnx.load(path, knots_per_period=4)
    x, y = np.linspace(DETAIL[0], DETAIL[1], 400), np.linspace(DETAIL[2], DETAIL[3], 400)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    axes.contour(
        x, y, model.evaluate(grid.reshape(-1, 2)).reshape(400, 400), [model.level], colors=TRUE_COLOUR, linewidths=5
    )
    for (knots, curve), colour in zip(curves.items(), ("#e2a16f", "#86b89a", COLOURS["ours"]), strict=True):
        lines = LineCollection(list(curve.vertices[curve.segments]), colors=colour, label=f"{knots} knots per period")
        axes.add_collection(lines)
        axes.plot(*curve.vertices.T, ".", color=colour, ms=4)
    axes.plot([], color=TRUE_COLOUR, linewidth=5, label="true level set")
    axes.set(xlim=DETAIL[:2], ylim=DETAIL[2:], aspect="equal")
    axes.legend(frameon=False, fontsize=8, loc="lower left")


def main(path: str, picture: str) -> None:
    """Measure the network ``path`` and draw ``picture``."""
    mpl.use("Agg")
    found = {knots: measure(path, knots) for knots in KNOTS_PER_PERIOD}
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.4), width_ratios=(1.25, 1))
    draw_errors(left, {name: [found[knots][name][1] for knots in KNOTS_PER_PERIOD] for name in COLOURS})
    draw_curves(right, path, {knots: found[knots]["ours"][0] for knots in SHOWN})
    figure.tight_layout()
    figure.savefig(picture, dpi=130)
    for knots, both in found.items():
        print(knots, *(f"{name}: {errors}" for name, (_, errors) in both.items()), sep="  ")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2])
