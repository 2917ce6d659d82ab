"""Scalar expressions: evaluation, exact simplification, enclosures, kinks and discontinuities."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar import breakpoints, discontinuities, evaluate, jet, simplify

SAMPLES = np.linspace(-4.0, 4.0, 801)


def c(value: float) -> Expression:
    return constant(value)


def clip(x: Expression, low: float, high: float) -> Expression:
    return apply("minimum", apply("maximum", x, c(low)), c(high))


RELU = apply("maximum", T, c(0.0))
HARD_SIGMOID = clip(apply("add", apply("multiply", c(0.2), T), c(0.5)), 0.0, 1.0)
SIGMOID = apply("sigmoid", T)
SOFTPLUS = apply("log", apply("add", c(1.0), apply("exp", T)))
GELU = apply(
    "multiply", apply("multiply", c(0.5), T), apply("add", c(1.0), apply("erf", apply("multiply", c(0.5**0.5), T)))
)
GELU_TANH = apply(
    "multiply",
    apply("multiply", c(0.5), T),
    apply(
        "add",
        c(1.0),
        apply(
            "tanh",
            apply(
                "multiply",
                c(math.sqrt(2 / math.pi)),
                apply("add", T, apply("multiply", c(0.044715), apply("power", T, c(3.0)))),
            ),
        ),
    ),
)
SILU = apply("multiply", T, SIGMOID)
MISH = apply("multiply", T, apply("tanh", SOFTPLUS))
ELU = apply("where", apply("less", c(0.0), T), T, apply("subtract", apply("exp", T), c(1.0)))
SOFTSIGN = apply("divide", T, apply("add", c(1.0), apply("abs", T)))
HARD_SWISH = apply("multiply", T, clip(apply("add", apply("divide", T, c(6.0)), c(0.5)), 0.0, 1.0))
SNAKE = apply("add", T, apply("power", apply("sin", apply("multiply", c(3.0), T)), c(2.0)))
SQUAREPLUS = apply("multiply", c(0.5), apply("add", T, apply("sqrt", apply("add", apply("multiply", T, T), c(4.0)))))
GAUSSIAN = apply("exp", apply("negate", apply("multiply", c(2.0), apply("power", T, c(2.0)))))
FINER = apply("sin", apply("multiply", T, apply("add", c(1.0), apply("abs", T))))

ACTIVATIONS = {
    "sigmoid": (SIGMOID, lambda t: 1 / (1 + np.exp(-t))),
    "softplus": (SOFTPLUS, lambda t: np.log1p(np.exp(t))),
    "gelu": (GELU, lambda t: 0.5 * t * np.array([1 + math.erf(x / math.sqrt(2)) for x in np.ravel(t)])),
    "gelu_tanh": (GELU_TANH, lambda t: 0.5 * t * (1 + np.tanh(math.sqrt(2 / math.pi) * (t + 0.044715 * t**3)))),
    "silu": (SILU, lambda t: t / (1 + np.exp(-t))),
    "mish": (MISH, lambda t: t * np.tanh(np.log1p(np.exp(t)))),
    "elu": (ELU, lambda t: np.where(t > 0, t, np.expm1(t))),
    "softsign": (SOFTSIGN, lambda t: t / (1 + np.abs(t))),
    "hard_swish": (HARD_SWISH, lambda t: t * np.clip(t / 6 + 0.5, 0, 1)),
    "snake": (SNAKE, lambda t: t + np.sin(3 * t) ** 2),
    "squareplus": (SQUAREPLUS, lambda t: (t + np.sqrt(t * t + 4)) / 2),
    "gaussian": (GAUSSIAN, lambda t: np.exp(-2 * t * t)),
    "finer": (FINER, lambda t: np.sin(t * (1 + np.abs(t)))),
}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activation_values(name: str) -> None:
    expression, reference = ACTIVATIONS[name]
    np.testing.assert_allclose(evaluate(expression, SAMPLES), reference(SAMPLES), rtol=1e-13, atol=1e-15)


def test_large_and_small_arrays_agree_on_erf() -> None:
    many = np.linspace(-5, 5, 10_000)
    np.testing.assert_array_equal(evaluate(GELU, many)[:100], evaluate(GELU, many[:100]))


def test_softplus_spelled_with_exponentials_does_not_overflow() -> None:
    guarded = apply("where", apply("less", c(20.0), T), T, SOFTPLUS)
    t = np.array([-1e4, 0.0, 1e4])
    np.testing.assert_allclose(evaluate(SOFTPLUS, t), [0.0, math.log(2), 1e4])
    np.testing.assert_allclose(evaluate(guarded, t), [0.0, math.log(2), 1e4])
    logaddexp = apply("add", RELU, apply("log", apply("add", c(1.0), apply("exp", apply("negate", apply("abs", T))))))
    np.testing.assert_allclose(evaluate(logaddexp, SAMPLES), np.logaddexp(0, SAMPLES), rtol=1e-14)
    curvature = jet(logaddexp, np.array([-0.1]), np.array([0.1])).curvature
    assert curvature.upper[0] < 0.26, "the kinks of both terms cancel"


@pytest.mark.parametrize(
    ("expression", "knots", "reference"),
    [
        (RELU, [0.0], lambda t: np.maximum(t, 0)),
        (apply("multiply", T, apply("sign", T)), [0.0], np.abs),
        (apply("divide", apply("add", T, apply("abs", T)), c(2.0)), [0.0], lambda t: np.maximum(t, 0)),
        (
            apply("multiply", T, apply("where", apply("less", c(0.0), T), c(1.0), c(0.25))),
            [0.0],
            lambda t: np.where(t > 0, t, 0.25 * t),
        ),
        (HARD_SIGMOID, [-2.5, 2.5], lambda t: np.clip(0.2 * t + 0.5, 0, 1)),
        (clip(T, -3.4028234663852886e38, 1.0), [1.0], lambda t: np.minimum(t, 1)),
        (
            apply("where", apply("less", c(2.0), T), apply("subtract", apply("multiply", c(3.0), T), c(4.0)), T),
            [2.0],
            lambda t: np.where(t > 2, 3 * t - 4, t),
        ),
        (
            apply("subtract", apply("abs", apply("subtract", apply("abs", T), c(1.0))), c(0.5)),
            [-1.0, 0.0, 1.0],
            lambda t: np.abs(np.abs(t) - 1) - 0.5,
        ),
        (apply("sqrt", apply("multiply", T, T)), [0.0], np.abs),
        (apply("add", apply("multiply", T, c(3.0)), apply("exp", c(0.0))), [], lambda t: 3 * t + 1),
        (
            apply("where", apply("and", apply("less", c(-1.0), T), apply("less", T, c(1.0))), c(0.0),
                  apply("subtract", T, apply("sign", T))),
            [-1.0, 1.0],
            lambda t: np.sign(t) * np.maximum(np.abs(t) - 1, 0),
        ),
    ],
)  # fmt: skip
def test_piecewise_linear_expressions_become_tables(expression, knots, reference) -> None:
    table = simplify(expression)
    assert isinstance(table, KnotTable)
    np.testing.assert_array_equal(table.knots, knots)
    np.testing.assert_allclose(table.evaluate(SAMPLES)[0], reference(SAMPLES), rtol=1e-15, atol=1e-15)
    assert not table.errors.any()


@pytest.mark.parametrize("expression", [HARD_SWISH, apply("multiply", T, T), SIGMOID, apply("floor", T),
                                        apply("sign", T),
                                        apply("where", apply("equal", T, c(1.0)), c(5.0), T)])  # fmt: skip
def test_other_expressions_stay(expression: Expression) -> None:
    assert isinstance(simplify(expression), Expression)


@st.composite
def piecewise_linear(draw: st.DrawFn, depth: int = 3) -> Expression:
    """Random continuous piecewise-linear expressions."""
    number = st.floats(-2, 2, allow_nan=False).map(lambda x: c(round(x, 3)))
    if depth == 0:
        return draw(st.one_of(st.just(T), number))
    op = draw(st.sampled_from(["add", "subtract", "maximum", "minimum", "abs", "negate", "scale"]))
    inner = piecewise_linear(depth - 1)
    if op == "scale":
        return apply("multiply", draw(number), draw(inner))
    return apply(op, *(draw(inner) for _ in range(1 if op in ("abs", "negate") else 2)))


@settings(max_examples=100, deadline=None)
@given(piecewise_linear())
def test_simplification_preserves_values_and_continuity(expression: Expression) -> None:
    table = simplify(expression)
    assert isinstance(table, KnotTable)
    np.testing.assert_allclose(table.evaluate(SAMPLES)[0], evaluate(expression, SAMPLES), rtol=1e-13, atol=1e-13)
    left = table.slopes[0, :-1] * table.knots + table.intercepts[0, :-1]
    right = table.slopes[0, 1:] * table.knots + table.intercepts[0, 1:]
    np.testing.assert_allclose(left, right, rtol=1e-13, atol=1e-13)


ENCLOSED = {name: expression for name, (expression, _) in ACTIVATIONS.items()} | {
    op: apply(op, T) for op in ("sin", "cos", "tan", "tanh", "erf", "atan", "asinh", "sinh", "cosh", "exp", "abs")
} | {
    "log": apply("log", apply("add", T, c(5.0))),
    "sqrt": apply("sqrt", apply("add", T, c(5.0))),
    "acosh": apply("acosh", apply("add", T, c(6.0))),
    "asin": apply("asin", apply("divide", T, c(5.0))),
    "acos": apply("acos", apply("divide", T, c(5.0))),
    "atanh": apply("atanh", apply("divide", T, c(5.0))),
    "power_3": apply("power", T, c(3.0)),
    "power_-2": apply("power", apply("add", T, c(5.0)), c(-2.0)),
    "power_1.5": apply("power", apply("add", T, c(5.0)), c(1.5)),
    "minimum": apply("minimum", apply("sin", T), c(0.25)),
}  # fmt: skip


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(ENCLOSED)), st.floats(-4, 4), st.floats(1e-4, 2))
def test_enclosures_contain_values_and_divided_differences(name: str, start: float, width: float) -> None:
    """The mean value theorem: first (second) divided differences are values of the slope (half the curvature)."""
    expression, stop = ENCLOSED[name], min(start + width, 4.0)
    enclosure = jet(expression, np.array([start]), np.array([stop]))
    t = np.linspace(start, stop, 65)
    y = evaluate(expression, t)
    assert (y >= enclosure.value.lower[0]).all()
    assert (y <= enclosure.value.upper[0]).all()
    if not enclosure.value.is_bounded[0] or t[1] == t[0]:
        return
    step = t[1] - t[0]
    noise = 8 * np.finfo(float).eps * (np.abs(y).max() + np.abs(t).max())
    first = np.diff(y) / np.diff(t)
    assert (first >= enclosure.slope.lower[0] - noise / step).all()
    assert (first <= enclosure.slope.upper[0] + noise / step).all()
    second = np.diff(first) / (0.5 * (t[2:] - t[:-2]))
    scale = noise / step**2 * 4
    assert (second >= enclosure.curvature.lower[0] - scale).all()
    assert (second <= enclosure.curvature.upper[0] + scale).all()


@pytest.mark.parametrize("name", ENCLOSED)
def test_enclosures_converge(name: str) -> None:
    """Curvature enclosures of narrow intervals are narrow, away from kinks and poles."""
    edges = np.linspace(0.3, 0.9, 1001)
    enclosure = jet(ENCLOSED[name], edges[:-1], edges[1:])
    kinks = breakpoints(ENCLOSED[name], 0.3, 0.9)
    smooth = np.ones(1000, bool)
    for kink in kinks:
        smooth &= (edges[1:] < kink) | (edges[:-1] > kink)
    width = enclosure.curvature.width[smooth]
    assert width.max() < 0.5


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (ELU, [0.0]),
        (SOFTSIGN, [0.0]),
        (HARD_SWISH, [-3.0, 3.0]),
        (apply("maximum", apply("sin", T), c(0.5)), [math.pi / 6 - 2 * math.pi, -7 * math.pi / 6, math.pi / 6,
                                                     5 * math.pi / 6]),
        (SIGMOID, []),
    ],
)  # fmt: skip
def test_breakpoints(expression: Expression, expected: list[float]) -> None:
    expected = [t for t in expected if -4 < t < 4]
    np.testing.assert_allclose(breakpoints(expression, -4.0, 4.0), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (apply("floor", T), [-1.0, 0.0, 1.0]),
        (apply("reciprocal", apply("subtract", T, c(0.5))), [0.5]),
        (apply("where", apply("less", T, c(0.25)), T, c(1.0)), [0.25]),
        (apply("tan", apply("multiply", c(1.5), T)), [-math.pi / 3, math.pi / 3]),
        (apply("sqrt", apply("abs", T)), []),
        (apply("where", apply("less", T, c(0.25)), T, c(0.25 + 1e-9)), []),
        *((expression, []) for expression, _ in ACTIVATIONS.values()),
    ],
)
def test_discontinuities(expression: Expression, expected: list[float]) -> None:
    found = np.array(discontinuities(expression, -1.25, 1.25))
    assert len(expected) == 0 or found.size
    for jump in expected:
        assert np.abs(found - jump).min() < 1e-14
    assert all(np.abs(np.array(expected) - jump).min(initial=np.inf) < 1e-14 for jump in found)


def test_undefined_part_of_the_range_is_found() -> None:
    assert discontinuities(apply("log", T), -1.0, 1.0)
    with pytest.raises(ValueError, match="finite"):
        discontinuities(T, -math.inf, 1.0)


def test_wrong_arity_is_refused() -> None:
    with pytest.raises(ValueError, match="'maximum' with 1 arguments"):
        apply("maximum", T)


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("softplus", lambda x: math.log1p(math.exp(-abs(x))) + max(x, 0.0)),
        ("sigmoid", lambda x: 1.0 / (1.0 + math.exp(-x)) if x >= 0 else math.exp(x) / (1.0 + math.exp(x))),
    ],
)
def test_exponentials_of_large_arrays_agree_with_the_library(name: str, form: Callable[[float], float]) -> None:
    rng = np.random.default_rng(0)
    t = np.concatenate([rng.normal(size=3000) * scale for scale in (1e-9, 0.1, 1.0, 20.0, 150.0)] + [[0.0, -0.0]])
    expected = np.array([form(x) for x in t.tolist()])
    assert (np.abs(evaluate(apply(name, T), t) - expected) / np.spacing(expected)).max() < 5
    beyond = np.concatenate([np.full(5000, -1e4), [-np.inf, np.inf, np.nan, 1e4, -745.0]])
    limits = {"softplus": [np.inf, np.nan, 1e4], "sigmoid": [1.0, np.nan, 1.0]}[name]
    found = evaluate(apply(name, T), beyond)
    np.testing.assert_allclose(found, [0.0] * 5001 + limits + [0.0], rtol=0, atol=1e-307)


@pytest.mark.parametrize(("library", "name"), [(np.sin, "sin"), (np.cos, "cos")])
def test_waves_of_large_arrays_agree_with_the_library(library: Callable[[np.ndarray], np.ndarray], name: str) -> None:
    rng = np.random.default_rng(0)
    near_quarters = np.arange(-1500, 1500) * (np.pi / 2) + rng.normal(size=3000) * 1e-6
    t = np.concatenate([rng.uniform(-40, 40, 3000), rng.uniform(-1e6, 1e6, 3000), near_quarters, [0.0, -0.0, 1e-300]])
    expected = library(t)
    ulps = np.abs(evaluate(apply(name, T), t) - expected) / np.spacing(np.abs(expected))
    assert ulps.max() < 3
    beyond = np.concatenate([t, [1e18, np.inf, np.nan]])
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(evaluate(apply(name, T), beyond), library(beyond))
