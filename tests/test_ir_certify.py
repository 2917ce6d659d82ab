"""Certified errors of surrogate networks, and refinement to a tolerance."""

from __future__ import annotations

import functools
import importlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import ELU, PIECEWISE_LINEAR, RELU, SILU, SINE, SMOOTH, TANH, dense, networks, softplus, unit_box

from mn_onnx.ir import scalar
from mn_onnx.ir.bounds import unit_bounds
from mn_onnx.ir.cell_relaxation import FlatProfiles, flat_profiles, relax_cells
from mn_onnx.ir.certify import certify
from mn_onnx.ir.error_propagation import ErrorPropagation
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import KnotTable, Network
from mn_onnx.ir.passes import Canonical, ToleranceNotReached, canonicalize
from mn_onnx.ir.ranges import RangeMaximum
from mn_onnx.ir.surrogate import fit
from mn_onnx.ir.surrogate.local_deviation import deviation_profile


def canonical(network: Network, **options) -> Canonical:
    lower, upper = unit_box(network)
    return canonicalize(network, lower=lower, upper=upper, **options)


def bounds_of(result: Canonical, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    known = unit_bounds(result.network, result.lower, result.upper)
    return ErrorPropagation(result.network, *known).bounds(lower, upper)


def differences(network: Network, points: np.ndarray) -> np.ndarray:
    return np.abs(evaluate(network, points, true_functions=True) - evaluate(network, points))


@settings(max_examples=25, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH), st.sampled_from([2.0, 8.0]))
def test_errors_stay_below_their_bounds(network: Network, knots_per_period: float) -> None:
    result = canonical(network, knots_per_period=knots_per_period)
    lower, upper = result.lower, result.upper
    certificate = certify(result.network, lower, upper, work=1e6)
    centres = np.random.default_rng(0).uniform(-0.9, 0.9, (60, network.input_dim))
    local = bounds_of(result, centres - 0.05, centres + 0.05)
    for shift in np.random.default_rng(1).uniform(-0.05, 0.05, (5, network.input_dim)):
        found = differences(result.network, centres + shift)
        assert (found <= local + 1e-12).all()
        assert found.max() <= certificate.error + 1e-12
    assert certificate.sampled <= certificate.error + 1e-12


@pytest.mark.parametrize("function", [TANH, SILU, ELU, SINE, softplus(10.0)])
def test_certificates_are_close_to_what_is_seen(function) -> None:
    result = canonical(dense([10, 10], function, seed=2, dimension=2))
    certificate = certify(result.network, result.lower, result.upper, work=2e9)
    dense_points = np.random.default_rng(3).uniform(-1, 1, (50_000, 2))
    seen = differences(result.network, dense_points).max()
    assert seen <= certificate.error <= 10 * seen


def test_local_bounds_are_sharper_than_global_ones() -> None:
    result = canonical(dense([24, 24, 24], softplus(30.0), seed=3))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 3))
    local = bounds_of(result, points - 1e-3, points + 1e-3)
    assert np.median(local) < 0.25 * certify(result.network, -np.ones(3), np.ones(3), work=1).error


def test_exact_networks_have_no_error() -> None:
    result = canonical(dense([8, 8], RELU))
    assert certify(result.network, result.lower, result.upper).error == 0.0


@pytest.mark.parametrize(("function", "tolerance"), [(TANH, 4e-3), (SINE, 3e-2), (softplus(20.0), 1e-3), (ELU, 2e-3)])
def test_refinement_reaches_the_tolerance(function, tolerance: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.import_module("mn_onnx.ir.passes.refine"), "ROUND_WORK", 3e8)
    network = dense([6, 6], function, seed=5, dimension=2)
    result = canonical(network, surrogate_tol=tolerance)
    assert result.surrogate_eps <= tolerance
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 2))
    assert differences(result.network, points).max() <= tolerance
    finer = canonical(network, surrogate_tol=tolerance / 16)
    assert finer.surrogate_eps <= tolerance / 16
    count = [sum(unit.table.knots.size for unit in r.network.units) for r in (result, finer)]
    assert count[1] > 2 * count[0]


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


@functools.cache
def fitted(function: Expression) -> tuple[KnotTable, FlatProfiles]:
    table = fit((function,), -7.0, 7.0, (1e-2,))
    return table, flat_profiles([deviation_profile(function, table, 0, -7.0, 7.0)])


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([TANH, SILU, ELU, SINE, softplus(20.0)]),
    st.floats(-3, 3), st.floats(0, 3), st.floats(-0.5, 0.5), st.floats(0, 0.5),
)  # fmt: skip
def test_relaxations_enclose_tables_and_differences(
    function: Expression, lower: float, width: float, less: float, more: float
) -> None:
    limits = np.array([-7.0]), np.array([7.0])
    table, profiles = fitted(function)
    place = np.zeros(1, np.int64)
    of_table = np.array([[lower]]), np.array([[lower + width]])
    of_difference = np.array([[less]]), np.array([[less + more]])
    relaxed = relax_cells(profiles, place, place, of_table, of_difference, limits)
    slope, middle, spread, shift, jump, reach = (part[0, 0] for part in relaxed)
    t = np.linspace(lower, lower + width, 301)
    y = table.evaluate(t)[0]
    assert np.abs(y - slope * t - middle).max() <= spread
    assert np.abs(y).max() <= reach
    for change in np.linspace(less, less + more, 9):
        true = scalar.evaluate(function, t + change)
        assert np.abs(true - y - slope * change - shift).max() <= jump + 1e-14
        assert np.abs(true).max() <= reach + 1e-14


@pytest.mark.parametrize("function", [TANH, SINE, softplus(100.0)])
def test_profiles_know_the_sign_of_deviations(function: Expression) -> None:
    table = fit((function,), -2.0, 3.0, (1e-3,))
    profile = deviation_profile(function, table, 0, -2.0, 3.0)
    t = np.linspace(-2.0, 3.0, 20_001)
    cell = np.searchsorted(profile.starts, t, side="right") - 1
    found = scalar.evaluate(function, t) - table.evaluate(t)[0]
    assert (profile.lowest[cell] <= found + 1e-15).all()
    assert (found <= profile.highest[cell] + 1e-15).all()
    width = profile.highest - profile.lowest
    assert np.median(width) < table.errors.max()


def test_deep_networks_are_certified_closely() -> None:
    """Signs of weights are kept from the error to the output: absolute values would lose a factor of 3 per layer."""
    result = canonical(dense([24] * 6, softplus(10.0), seed=4, dimension=2))
    certificate = certify(result.network, result.lower, result.upper, work=5e8)
    assert certificate.sampled <= certificate.error <= 10 * certificate.sampled
