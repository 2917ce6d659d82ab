"""The error of a level set against the number of knots: the circle of section 5.7 of the paper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mn_onnx.extract.planar.prism import extract_curve
from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.certify import certify
from mn_onnx.ir.evaluate import evaluate, gradient
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, Network
from mn_onnx.ir.scalar import evaluate as evaluate_function
from mn_onnx.model import Model, load

CIRCLE = Path(__file__).parent.parent / "models" / "circle_pe2_d2_w4.onnx"
KNOTS_PER_PERIOD = (4, 8, 16, 32, 64)


def circle(knots_per_period: float) -> Model:
    return load(CIRCLE, knots_per_period=knots_per_period)


def errors_on_the_curve(model: Model, network: Network) -> tuple[np.ndarray, np.ndarray]:
    """|f_true| and the distance from its level set (to first order) at points of the level set of ``network``."""
    curve = extract_curve(network, model.lower, model.upper, threads=1).curve
    assert curve.closed.all()
    assert curve.n_polylines == 1
    first, last = curve.vertices[curve.segments[:, 0]], curve.vertices[curve.segments[:, 1]]
    points = np.concatenate([first + share * (last - first) for share in np.linspace(0, 1, 9)])
    values = np.abs(evaluate(model.network, points, true_functions=True))
    slopes = np.sqrt((gradient(model.network, points, true_functions=True) ** 2).sum(axis=1))
    return values, values / slopes


def with_equal_knots(model: Model) -> Network:
    """As many knots in each table, equally spaced, with chords of the functions between them."""
    units = []
    lows, highs = unit_bounds(model.network, model.lower, model.upper)
    for unit, low, high in zip(model.network.units, lows, highs, strict=True):
        assert unit.table is not None
        functions = [function for function in unit.functions if isinstance(function, Expression)]
        if not functions:
            units.append(unit)
            continue
        nodes = np.linspace(low, high, unit.table.knots.size + 2)
        values = np.array([evaluate_function(function, nodes) for function in functions])
        slopes = np.diff(values) / np.diff(nodes)
        intercepts = values[:, :-1] - slopes * nodes[:-1]
        units.append(replace(unit, table=KnotTable(nodes[1:-1], slopes, intercepts, np.zeros_like(slopes))))
    return replace(model.network, units=tuple(units))


def test_errors_are_of_second_order_and_below_their_bound() -> None:
    largest, mean, knots = [], [], []
    for knots_per_period in KNOTS_PER_PERIOD:
        model = circle(knots_per_period)
        values, distances = errors_on_the_curve(model, model.network)
        assert values.max() <= certify(model.network, model.lower, model.upper, work=2e8).error
        largest.append(distances.max())
        mean.append(distances.mean())
        knots.append(sum(unit.table.knots.size for unit in model.network.units if len(unit.functions) > 1))
    for errors in (largest, mean):
        order = np.polyfit(np.log(knots), np.log(errors), 1)[0]
        assert order == pytest.approx(-2.0, abs=0.2)


@pytest.mark.parametrize("knots_per_period", [4, 16])
def test_placed_and_balanced_knots_beat_equal_ones(knots_per_period: float) -> None:
    model = circle(knots_per_period)
    _, ours = errors_on_the_curve(model, model.network)
    _, equal = errors_on_the_curve(model, with_equal_knots(model))
    assert ours.max() < 0.65 * equal.max()
    assert ours.mean() < 0.65 * equal.mean()
