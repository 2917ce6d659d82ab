"""Evaluation, gradients and bounds of rounding errors of networks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from ir_networks import (
    PIECEWISE_LINEAR,
    RELU,
    RELU_EXPRESSION,
    SILU,
    SMOOTH,
    STAIRS,
    TANH,
    dense,
    naive_values,
    networks,
    random_points,
    softplus,
)  # fmt: skip

from mn_onnx.ir.evaluate import evaluate, float64_error_bound, gradient, rounding_error_bound
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.ir.passes import canonicalize


@settings(max_examples=60, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH))
def test_values_agree_with_unit_by_unit_evaluation(network: Network) -> None:
    points = random_points(network, 50)
    np.testing.assert_allclose(evaluate(network, points), naive_values(network, points), rtol=1e-11, atol=1e-11)


def test_tables_or_true_functions() -> None:
    network = canonicalize(dense([8, 8], TANH), lower=-np.ones(3), upper=np.ones(3), knots_per_period=8).network
    points = random_points(network, 200)
    by_tables, true = evaluate(network, points), evaluate(network, points, true_functions=True)
    np.testing.assert_allclose(by_tables, naive_values(network, points, tables=True), atol=1e-13)
    np.testing.assert_allclose(true, naive_values(network, points), atol=1e-13)
    assert np.abs(by_tables - true).max() > 1e-4


@pytest.mark.parametrize("function", [RELU, STAIRS, SILU, TANH, softplus(10.0)])
def test_gradients_agree_with_differences(function) -> None:
    network = dense([12, 9], function, seed=3)
    points = random_points(network, 40)
    step = 1e-6
    steps = step * np.eye(3)
    differences = np.stack(
        [(evaluate(network, points + d) - evaluate(network, points - d)) / (2 * step) for d in steps], axis=1
    )
    # Points within a step of a knot see two slopes.
    smooth = np.abs(evaluate(network, points + step) + evaluate(network, points - step) - 2 * evaluate(network, points))
    close = smooth < 1e-11
    assert close.sum() > 30
    np.testing.assert_allclose(gradient(network, points)[close], differences[close], atol=1e-6)


def test_gradient_of_units_with_several_outputs() -> None:
    row = AffineRow(np.array([0]), np.array([2.0]), 0.1)
    unit = Unit(row, (RELU, SILU, RELU), "many")
    output = AffineRow(np.array([0, 1, 2, 3]), np.array([1.0, 1.0, 1.0, 0.5]), 0.0)
    network = Network(1, (unit,), output)
    points = np.array([[0.7], [-0.3]])
    step = 1e-6
    differences = (evaluate(network, points + step) - evaluate(network, points - step)) / (2 * step)
    np.testing.assert_allclose(gradient(network, points)[:, 0], differences, atol=1e-7)


def test_many_points_are_evaluated_in_chunks() -> None:
    network = dense([64, 64])
    points = random_points(network, 9000)
    np.testing.assert_allclose(evaluate(network, points)[-7:], evaluate(network, points[-7:]), atol=1e-14)


def test_points_of_another_dimension_are_refused() -> None:
    with pytest.raises(ValueError, match=r"points must be \[n, 3\], not \[5, 2\]"):
        evaluate(dense([4]), np.zeros((5, 2)))


def _values_in(network: Network, points: np.ndarray, dtype: type) -> np.ndarray:
    """The value computed wholly in ``dtype``, summing from left to right."""
    variables = [points[:, axis].astype(dtype) for axis in range(network.input_dim)]

    def row_values(row: AffineRow) -> np.ndarray:
        total = np.zeros(points.shape[0], dtype)
        for column, weight in zip(row.columns, row.weights, strict=True):
            total = (total + (dtype(weight) * variables[column]).astype(dtype)).astype(dtype)
        return (total + dtype(row.bias)).astype(dtype)

    for unit in network.units:
        t = row_values(unit.row)
        variables.append(np.tanh(t) if unit.functions[0] is TANH else np.maximum(t, dtype(0)))
    return row_values(network.output)


@pytest.mark.parametrize("function", [RELU, TANH])
@pytest.mark.parametrize(("dtype", "roundoff"), [(np.float32, 2.0**-24), (np.float16, 2.0**-11)])
def test_rounding_errors_stay_below_their_bound(function, dtype, roundoff) -> None:
    network = dense([16, 16, 16], function, seed=5)
    rows = [unit.row for unit in network.units]
    exact = [AffineRow(r.columns, r.weights.astype(dtype).astype(float), float(dtype(r.bias))) for r in rows]
    units = tuple(Unit(row, unit.functions, unit.name) for row, unit in zip(exact, network.units, strict=True))
    network = Network(3, units, network.output)
    points = random_points(network, 300).astype(dtype).astype(float)
    error = np.abs(_values_in(network, points, dtype) - evaluate(network, points))
    bound = rounding_error_bound(network, points, unit_roundoff=roundoff)
    assert (error <= bound).all()
    assert bound.max() < 1000 * error.max(), "a bound that allows everything checks nothing"


@pytest.mark.parametrize("relu", [RELU, RELU_EXPRESSION])
def test_a_knot_within_the_rounding_of_a_pre_activation_is_allowed_for(relu: KnotTable | Expression) -> None:
    """``relu(0.1 x + 0.2 y - 0.3 z)`` near zero: in floating point it may be positive where it is zero."""
    unit = Unit(AffineRow(np.arange(3), np.array([0.1, 0.2, -0.3]), 0.0), (relu,), "relu")
    network = Network(3, (unit,), AffineRow(np.array([3]), np.ones(1), 0.0))
    points = np.array([[1.0, 1.0, 1.0 + 2.0**-30], [1.0, 1.0, 1.1]])
    assert not evaluate(network, points).any()
    near, far = rounding_error_bound(network, points, unit_roundoff=2.0**-24)
    assert 2.0**-24 * 0.1 < near < 1e-5
    assert far < 0.1 * near


def test_float64_bound_is_small_and_covers_the_order_of_summation() -> None:
    network = canonicalize(dense([32, 32], seed=2), lower=-np.ones(3), upper=np.ones(3)).network
    points = random_points(network, 200)
    bound = float64_error_bound(network, points)
    assert (np.abs(evaluate(network, points) - naive_values(network, points)) <= bound).all()
    assert bound.max() < 1e-12
