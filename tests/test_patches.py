"""Kernels of patches: intervals of tables, and lines that hold a function on ranges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import RELU, SILU, SINE

from mn_onnx.extract.kernels.patches import Relaxed, Tables, find_interval, relax_level
from mn_onnx.ir.expression import T, apply, constant
from mn_onnx.ir.network import KnotTable, ScalarFunction
from mn_onnx.ir.scalar import evaluate
from mn_onnx.ir.surrogate.close_table import close_table
from mn_onnx.ir.surrogate.fit import fit

LOWEST, HIGHEST = -6.0, 7.0


@settings(deadline=None)
@given(st.sets(st.integers(0, 200), min_size=1, max_size=60), st.integers(0, 60), st.integers(-2, 202))
def test_intervals_are_found_from_any_guess(knots: set[int], guess: int, t: int) -> None:
    before = np.full(3, 50.0)  # a table's intervals stand behind those of others
    starts = np.concatenate([before, [-np.inf], np.sort(np.array(list(knots), np.float64)), [-np.inf, 7.0]])
    end = 3 + 1 + len(knots)
    found = find_interval(starts, 3, end, min(3 + guess, end - 1), float(t))
    assert found == 3 + np.searchsorted(starts[4:end], t, side="right")


def tables_of(function: ScalarFunction) -> Tables:
    """The flat form of one close table."""
    coarse = function if isinstance(function, KnotTable) else fit((function,), LOWEST, HIGHEST, (1e-2,))
    table = close_table(function, coarse, 0, LOWEST, HIGHEST)
    return Tables(
        np.array([0, table.knots.size + 1]),
        np.concatenate([[-np.inf], table.knots]),
        table.slopes[0],
        table.intercepts[0],
        table.errors[0],
    )


def test_a_constant_stands_for_itself() -> None:
    """Its proved error is the smallest number there is; the tolerance, a thousandth of it, would be none at all."""
    function = apply("maximum", apply("subtract", apply("sigmoid", T), constant(2.0)), constant(0.0))
    assert tables_of(function).errors.max() < 1e-300


def test_rounding_of_a_knot_is_no_slope() -> None:
    """A range around a knot far smaller than what its lines miss each other by."""
    half, radius = 1e-300, np.zeros((1, 2, 1))
    tables = Tables(
        np.array([0, 2]), np.array([-np.inf, 0.0]), np.array([1.0, 2.0]), np.array([0.0, 1e-17]), np.zeros(2)
    )
    relaxed = Relaxed(np.empty((1, 1)), np.empty((1, 1)), np.empty((1, 1)))
    one, limits = np.zeros(1, np.int64), (np.array([-1.0]), np.array([1.0]))
    form = np.array([[[0.0], [half]]])
    relax_level(tables, one, one, limits, (form, radius), np.ones((1, 1)), relaxed)
    assert 1 <= relaxed.slope[0, 0] <= 2
    assert 0 <= relaxed.error[0, 0] < 1e-15


@pytest.mark.parametrize("function", [SINE, SILU, RELU], ids=["sine", "silu", "relu"])
@pytest.mark.parametrize("width", [1e-9, 1e-3, 0.1, 3.0])
def test_lines_hold_functions_on_ranges(function: ScalarFunction, width: float) -> None:
    n = 400
    middles = np.random.default_rng(0).uniform(LOWEST, HIGHEST, n)
    forms = np.stack([middles, np.full(n, 0.5 * width)], axis=1)[:, :, None]
    relaxed = Relaxed(np.empty((n, 1)), np.empty((n, 1)), np.empty((n, 1)))
    one, limits = np.zeros(1, np.int64), (np.array([LOWEST]), np.array([HIGHEST]))
    relax_level(tables_of(function), one, one, limits, (forms, np.zeros((n, 2, 1))), np.ones((n, 1)), relaxed)
    t = np.clip(middles[:, None] + width * np.linspace(-0.5, 0.5, 41), LOWEST, HIGHEST)
    values = function.evaluate(t)[0] if isinstance(function, KnotTable) else evaluate(function, t)
    missed = np.abs(values - (relaxed.slope * t + relaxed.intercept)).max(axis=1)
    assert (missed <= relaxed.error[:, 0]).all()
    assert (relaxed.error[:, 0] <= 1.1 * missed + 1e-4).all()
