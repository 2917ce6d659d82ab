"""Certified bounds of pre-activations and outputs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import ELU, PIECEWISE_LINEAR, RELU, SILU, SINE, SMOOTH, STAIRS, TANH, dense, networks, unit_box

from mn_onnx.ir.bounds import output_bounds, unit_bounds
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.expression import T, apply
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.ir.passes import canonicalize
from mn_onnx.ir.relaxation import relax_table, relax_units
from mn_onnx.ir.scalar import UndefinedFunction


@settings(max_examples=40, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH), st.floats(-1, 1), st.floats(0, 1))
def test_outputs_and_pre_activations_stay_in_their_bounds(network: Network, corner: float, size: float) -> None:
    lower = np.full(network.input_dim, corner)
    upper = lower + size
    points = np.random.default_rng(0).uniform(lower, upper, (200, network.input_dim))
    points = np.concatenate([points, lower[None], upper[None]])
    low, high = output_bounds(network, lower, upper)
    values = evaluate(network, points)
    assert low <= values.min()
    assert values.max() <= high
    t_lower, t_upper = unit_bounds(network, lower, upper)
    for index in range(len(network.units)):
        below = Network(network.input_dim, network.units[:index], network.units[index].row)
        t = evaluate(below, points)
        assert t_lower[index] <= t.min()
        assert t.max() <= t_upper[index]


def test_bounds_are_tight_on_small_boxes_and_exact_for_points() -> None:
    network = dense([20, 20], seed=4)
    point = np.array([0.3, -0.2, 0.1])
    value = float(evaluate(network, point[None])[0])
    low, high = output_bounds(network, point, point)
    assert high - low < 1e-12
    assert low <= value <= high
    low, high = output_bounds(network, point - 1e-4, point + 1e-4)
    corners = point + 1e-4 * np.array(list(itertools.product([-1, 1], repeat=3)))
    spread = np.ptp(evaluate(network, corners))
    assert spread <= high - low < 1.01 * spread


def test_backward_pass_sees_cancellation() -> None:
    """``relu(x) - relu(x)`` by two layers: interval arithmetic alone would give [-1, 1]."""
    units = [Unit(AffineRow(np.array([0]), np.array([1.0]), 2.0), (RELU,), "a")]
    units += [Unit(AffineRow(np.array([1]), np.array([1.0]), 1.0), (RELU,), name) for name in "bc"]
    network = Network(1, tuple(units), AffineRow(np.array([2, 3]), np.array([1.0, -1.0]), 0.0))
    low, high = output_bounds(network, -np.ones(1), np.ones(1))
    assert -1e-12 < low <= 0 <= high < 1e-12


@pytest.mark.parametrize("function", [RELU, STAIRS, TANH, SINE, SILU, ELU])
@pytest.mark.parametrize(("lower", "upper"), [(-2.0, 3.0), (0.1, 0.2), (-0.7, -0.7), (-1.0, 0.0)])
def test_relaxations_enclose_the_function(function, lower: float, upper: float) -> None:
    unit = Unit(AffineRow(np.array([0]), np.array([1.0]), 0.0), (function,), "unit")
    relaxation = relax_units([unit], np.array([lower]), np.array([upper]))
    network = Network(1, (unit,), AffineRow(np.array([1]), np.array([1.0]), 0.0))
    t = np.linspace(lower, upper, 1001)
    values = evaluate(network, t[:, None])
    offset = values - relaxation.slope[0] * t
    assert relaxation.lower[0] <= offset.min() + 1e-15
    assert offset.max() - 1e-15 <= relaxation.upper[0]
    assert relaxation.least[0] <= values.min() + 1e-15
    assert values.max() - 1e-15 <= relaxation.greatest[0]
    assert relaxation.upper[0] - relaxation.lower[0] <= 1.1 * np.ptp(offset) + 1e-9


def test_relaxation_is_widened_by_errors() -> None:
    exact = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.0]])
    table = KnotTable(exact.knots, exact.slopes, exact.intercepts, np.array([[0.25, 0.5]]))
    left, both = relax_table(table, -2.0, -1.0), relax_table(table, -2.0, 1.0)
    assert (left.lower[0], left.upper[0]) == (-0.25, 0.25)
    assert both.greatest[0] == 1.5


def test_true_network_stays_in_the_bounds_of_its_surrogate() -> None:
    network = dense([10, 10], TANH, seed=6)
    lower, upper = unit_box(network)
    canonical = canonicalize(network, lower=lower, upper=upper, knots_per_period=2).network
    low, high = output_bounds(canonical, lower, upper)
    values = evaluate(network, np.random.default_rng(0).uniform(-1, 1, (5000, 3)))
    assert low <= values.min()
    assert values.max() <= high


def test_invalid_boxes_and_unbounded_functions_are_refused() -> None:
    network = dense([3])
    with pytest.raises(ValueError, match="needs 3 lower and upper bounds"):
        output_bounds(network, np.zeros(2), np.ones(2))
    with pytest.raises(ValueError, match="lower <= upper"):
        output_bounds(network, np.ones(3), np.zeros(3))
    pole = dense([3], apply("reciprocal", T), seed=1)
    with pytest.raises(UndefinedFunction, match=r"layer0\[0\]: its function is unbounded"):
        output_bounds(pole, -np.ones(3), np.ones(3))
