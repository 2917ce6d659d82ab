"""Surrogates of scalar functions: proved errors, economy of knots, continuity, refusals."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import ELU, RELU, SILU, SINE, TANH, softplus

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar import UndefinedFunction, evaluate
from mn_onnx.ir.scalar.deviation import deviation
from mn_onnx.ir.spec import continuity_gap
from mn_onnx.ir.surrogate import bend_profile, error_of_knots, fit, kinks

GELU = apply(
    "multiply", apply("multiply", constant(0.5), T),
    apply("add", constant(1.0), apply("erf", apply("multiply", constant(0.5**0.5), T))),
)  # fmt: skip
FUNCTIONS: dict[str, Expression] = {
    "tanh": TANH, "silu": SILU, "sine": SINE, "elu": ELU, "gelu": GELU, "softplus": softplus(1.0),
    "softplus100": softplus(100.0), "square": apply("power", T, constant(2.0)), "exp": apply("exp", T),
    "sqrt": apply("sqrt", apply("abs", T)),
    "softsign": apply("divide", T, apply("add", constant(1.0), apply("abs", T))),
    "clipped sine": apply("maximum", apply("sin", T), constant(0.3)),
}  # fmt: skip


def sampled_errors(table: KnotTable, function: Expression, lower: float, upper: float) -> np.ndarray:
    """The largest error seen on every interval of the table."""
    nodes = np.concatenate([[lower], table.knots, [upper]])
    t = nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(0, 1, 201)[None]
    index = np.arange(nodes.size - 1)[:, None]
    values = table.slopes[0][index] * t + table.intercepts[0][index]
    return np.abs(values - evaluate(function, t)).max(axis=1)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(FUNCTIONS)), st.floats(-4, 3), st.floats(0.05, 5), st.sampled_from([1e-1, 1e-2, 1e-3]))
def test_proved_errors_hold_and_are_not_loose(name: str, lower: float, width: float, tolerance: float) -> None:
    function, upper = FUNCTIONS[name], lower + width
    table = fit([function], lower, upper, [tolerance])
    seen = sampled_errors(table, function, lower, upper)
    assert (seen <= table.errors[0] + 1e-15).all()
    assert table.errors.max() <= tolerance
    assert table.errors.max() <= 1.1 * seen.max() + 1e-9
    assert continuity_gap(table) <= 1


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_errors_fall_with_the_square_of_the_knots(name: str) -> None:
    function = FUNCTIONS[name]
    coarse, fine = (fit([function], -2.0, 3.0, [tolerance]) for tolerance in (1e-3, 1e-5))
    ratio = (fine.knots.size + 1) / (coarse.knots.size + 1)
    assert ratio < 13, "a hundredth of the error takes ten times the knots"
    assert fine.errors.max() <= 1e-5


def test_best_offsets_halve_the_error_of_interpolation() -> None:
    """``t**2`` with n pieces on [0, 1]: sup error 1 / (8 n**2) at best offset, 1 / (4 n**2) interpolated."""
    square = FUNCTIONS["square"]
    table = fit([square], 0.0, 1.0, [1.03 / (8 * 10**2)])
    assert table.knots.size == 9
    np.testing.assert_allclose(table.knots, np.linspace(0, 1, 11)[1:-1], atol=1e-3)
    assert table.errors.max() <= 1.02 / 800


def test_sharp_softplus_needs_knots_only_where_it_bends() -> None:
    table = fit([softplus(100.0)], -50.0, 50.0, [1e-4])
    assert table.knots.size < 16
    assert np.abs(table.knots).max() < 0.2
    np.testing.assert_allclose(table.slopes[0, [0, -1]], [0, 1], atol=1e-4)


def test_knots_per_period() -> None:
    periods = 5
    sine = apply("sin", T)
    lower, upper = 0.0, 2 * np.pi * periods
    profile = bend_profile(sine, lower, upper, ())
    assert profile.lobes == 2 * periods
    table = fit([sine], lower, upper, [error_of_knots(profile, 16)])
    assert 16 * periods - 1 <= table.knots.size <= 1.4 * 16 * periods


def test_knots_stand_at_kinks() -> None:
    np.testing.assert_array_equal(kinks(ELU, -3.0, 3.0), [])
    softsign_like = apply("divide", T, apply("add", constant(1.0), RELU_LIKE))
    assert kinks(softsign_like, -3.0, 3.0).size == 0
    clipped = FUNCTIONS["clipped sine"]
    corner = np.arcsin(0.3)
    table = fit([clipped], 0.0, 1.5, [1e-2])
    assert np.abs(table.knots - corner).min() < 1e-14


RELU_LIKE = apply("maximum", T, constant(0.0))


def test_functions_of_one_unit_share_knots() -> None:
    sines = [apply(op, apply("multiply", constant(k), T)) for k in (1.0, 2.0, 4.0) for op in ("sin", "cos")]
    together = fit(sines, -3.0, 3.0, [1e-3] * 6)
    alone = sum(fit([sine], -3.0, 3.0, [1e-3]).knots.size for sine in sines)
    assert together.knots.size < 0.5 * alone
    for index, sine in enumerate(sines):
        part = KnotTable(together.knots, *(a[[index]] for a in (together.slopes, together.intercepts, together.errors)))
        assert (sampled_errors(part, sine, -3.0, 3.0) <= part.errors[0] + 1e-15).all()


def test_tables_beside_smooth_functions_stay_exact() -> None:
    table = fit([TANH, RELU], -2.0, 2.0, [1e-2, 0.0])
    t = np.linspace(-2, 2, 1001)
    np.testing.assert_allclose(table.evaluate(t)[1], np.maximum(t, 0), atol=1e-16)
    assert 0.0 in table.knots
    assert not table.errors[1].any()


def test_range_of_one_point() -> None:
    table = fit([TANH, RELU], 0.5, 0.5, [1e-2, 0.0])
    np.testing.assert_allclose(table.evaluate(np.array(0.5)), [np.tanh(0.5), 0.5])


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (apply("floor", T), r"jumps or is undefined at pre-activation -1, .*inside its range \[-2, 2\]"),
        (apply("reciprocal", T), "jumps or is undefined at pre-activation"),
        (apply("log", T), "jumps or is undefined"),
    ],
)
def test_functions_without_surrogate_are_refused(function: Expression, message: str) -> None:
    with pytest.raises(UndefinedFunction, match=message):
        fit([function], -2.0, 2.0, [1e-3])


def test_small_jumps_become_part_of_the_error_or_are_refused() -> None:
    softplus_branch = apply("softplus", T)
    guarded = apply("where", apply("less", constant(5.0), T), T, softplus_branch)
    jump = np.log1p(np.exp(5.0)) - 5.0
    with pytest.raises(UndefinedFunction, match="jumps"):
        fit([guarded], 0.0, 10.0, [1e-2])
    guarded = apply("where", apply("less", constant(20.0), T), T, softplus_branch)
    jump = np.log1p(np.exp(20.0)) - 20.0
    table = fit([guarded], 0.0, 30.0, [1e-2])
    assert (sampled_errors(table, guarded, 0.0, 30.0) <= table.errors[0]).all()
    with pytest.raises(UndefinedFunction, match="cannot be followed"):
        fit([guarded], 19.0, 21.0, [jump / 8])


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(sorted(FUNCTIONS)), st.floats(-4, 3), st.floats(1e-3, 4), st.floats(-2, 2), st.floats(-1, 1))
def test_deviation_encloses_and_is_attained(
    name: str, lower: float, width: float, slope: float, intercept: float
) -> None:
    function = FUNCTIONS[name]
    ends = (np.array([x]) for x in (lower, lower + width, slope, intercept))
    sure, attained = deviation(function, *ends)
    t = np.linspace(lower, lower + width, 2001)
    values = evaluate(function, t) - (slope * t + intercept)
    rounding = 1e-14 * (1 + np.abs(values).max())
    assert sure.lower[0] <= values.min() + rounding
    assert values.max() - rounding <= sure.upper[0]
    spread = attained.upper[0] - attained.lower[0]
    assert sure.upper[0] - sure.lower[0] <= 1.05 * spread + 1e-10


def test_where_a_function_is_zero_nothing_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounded outward, zero is a range around it, and no fraction of zero is a gap that would do."""
    module = importlib.import_module("mn_onnx.ir.scalar.deviation")
    sizes, bounds = [], module._cell_bounds

    def counted(expression: Expression, low: np.ndarray, *rest: np.ndarray) -> object:
        sizes.append(low.size)
        return bounds(expression, low, *rest)

    monkeypatch.setattr(module, "_cell_bounds", counted)
    function = apply("maximum", apply("add", apply("multiply", T, apply("tanh", T)), constant(-9.0)), constant(0.0))
    edges = np.linspace(-4.0, 3.0, 8)
    sure, _ = module.deviation(function, edges[:-1], edges[1:], np.full(7, 1e-323), np.full(7, 1e-323))
    assert sure.magnitude.max() < 1e-300
    assert max(sizes) < 100
