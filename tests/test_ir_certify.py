"""Certified errors of surrogate networks, and refinement to a tolerance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import ELU, PIECEWISE_LINEAR, RELU, SILU, SINE, SMOOTH, TANH, dense, networks, softplus, unit_box

from mn_onnx.ir.certify import certified_error, certify, error_bounds
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import KnotTable, Network
from mn_onnx.ir.passes import Canonical, ToleranceNotReached, canonicalize
from mn_onnx.ir.ranges import OutputRanges, RangeMaximum


def canonical(network: Network, **options) -> Canonical:
    lower, upper = unit_box(network)
    return canonicalize(network, lower=lower, upper=upper, **options)


def differences(network: Network, points: np.ndarray) -> np.ndarray:
    return np.abs(evaluate(network, points, true_functions=True) - evaluate(network, points))


@settings(max_examples=25, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH), st.sampled_from([2.0, 8.0]))
def test_errors_stay_below_their_bounds(network: Network, knots_per_period: float) -> None:
    result = canonical(network, knots_per_period=knots_per_period)
    lower, upper = result.lower, result.upper
    certificate = certify(result.network, lower, upper, work=2e6)
    centres = np.random.default_rng(0).uniform(-0.9, 0.9, (60, network.input_dim))
    local = error_bounds(result.network, centres - 0.05, centres + 0.05)
    for shift in np.random.default_rng(1).uniform(-0.05, 0.05, (5, network.input_dim)):
        found = differences(result.network, centres + shift)
        assert (found <= local + 1e-12).all()
        assert found.max() <= certificate.error + 1e-12
    assert certificate.sampled <= certificate.error + 1e-12


@pytest.mark.parametrize("function", [TANH, SILU, ELU, SINE, softplus(10.0)])
def test_certificates_are_close_to_what_is_seen(function) -> None:
    result = canonical(dense([10, 10], function, seed=2, dimension=2))
    certificate = certify(result.network, result.lower, result.upper, work=2e8)
    dense_points = np.random.default_rng(3).uniform(-1, 1, (50_000, 2))
    seen = differences(result.network, dense_points).max()
    assert seen <= certificate.error <= 10 * seen


def test_local_bounds_are_sharper_than_global_ones() -> None:
    result = canonical(dense([24, 24, 24], softplus(30.0), seed=3))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 3))
    local = error_bounds(result.network, points - 1e-3, points + 1e-3)
    assert np.median(local) < 0.25 * certify(result.network, -np.ones(3), np.ones(3), work=1).error


def test_exact_networks_have_no_error() -> None:
    result = canonical(dense([8, 8], RELU))
    assert certified_error(result.network, result.lower, result.upper) == 0.0
    assert not error_bounds(result.network, np.zeros((4, 3)), np.ones((4, 3))).any()


@pytest.mark.parametrize(("function", "tolerance"), [(TANH, 4e-3), (SINE, 3e-2), (softplus(20.0), 1e-3), (ELU, 2e-3)])
def test_refinement_reaches_the_tolerance(function, tolerance: float) -> None:
    network = dense([6, 6], function, seed=5, dimension=2)
    result = canonical(network, surrogate_tol=tolerance)
    assert result.surrogate_eps <= tolerance
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 2))
    assert differences(result.network, points).max() <= tolerance
    coarse = canonical(network)
    count = [sum(unit.table.knots.size for unit in r.network.units) for r in (coarse, result)]
    assert coarse.surrogate_eps <= tolerance or count[1] > count[0]


def test_tolerances_out_of_reach_are_refused_with_the_reason() -> None:
    with pytest.raises(ToleranceNotReached, match=r"at most 1e-13 cannot be certified: with .* knots") as caught:
        canonical(dense([6, 6], TANH, dimension=2), surrogate_tol=1e-13)
    assert caught.value.certificate.error > 1e-13
    assert "layer" in str(caught.value)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=1, max_size=40), st.data())
def test_range_maxima(values: list[float], data: st.DataObject) -> None:
    first = data.draw(st.integers(0, len(values) - 1))
    last = data.draw(st.integers(first, len(values) - 1))
    found = RangeMaximum(np.array(values))(np.array([first, first]), np.array([last, first - 1]))
    assert found[0] == max(values[first : last + 1])
    assert found[1] == -np.inf


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.floats(-3, 3), st.floats(0, 3))
def test_output_ranges(seed: int, lower: float, width: float) -> None:
    rng = np.random.default_rng(seed)
    nodes = np.sort(rng.uniform(-2, 2, 8))
    values = rng.normal(size=8)
    slopes = np.diff(values) / np.diff(nodes)
    intercepts = values[:-1] - slopes * nodes[:-1]
    table = KnotTable(nodes[1:-1], slopes[None], intercepts[None], rng.random((1, 7)))
    ranges = OutputRanges(table, 0)
    low, high = np.array([lower]), np.array([lower + width])
    first, last = ranges.intervals(low), ranges.intervals(high)
    t = np.linspace(lower, lower + width, 400)
    least, greatest = ranges.values(low, high, first, last)
    sampled = table.evaluate(t)[0]
    assert least[0] <= sampled.min() + 1e-12
    assert sampled.max() - 1e-12 <= greatest[0]
    inside = np.searchsorted(table.knots, t, side="right")
    flattest, steepest = ranges.slopes(first, last)
    assert flattest[0] <= table.slopes[0, inside].min()
    assert steepest[0] >= table.slopes[0, inside].max()
    assert ranges.errors(first, last)[0] >= table.errors[0, inside].max()
