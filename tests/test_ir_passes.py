"""The passes: each keeps the level set, and the canonical form obeys its grammar."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ir_networks import (
    AFFINE,
    CLIP,
    ELU,
    LEAKY,
    PIECEWISE_LINEAR,
    RELU,
    RELU_EXPRESSION,
    SILU,
    SINE,
    SMOOTH,
    STAIRS,
    TANH,
    dense,
    networks,
    random_points,
    scalar_values,
    softplus,
    unit_box,
)  # fmt: skip

from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.expression import T, apply, constant
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.ir.passes import LOWERING, PASSES, Canonical, PassFailed, Program, canonicalize, run_passes
from mn_onnx.ir.passes.fuse_affine import FUSE_AFFINE
from mn_onnx.ir.passes.merge_proportional import MERGE_PROPORTIONAL, in_terms_of
from mn_onnx.ir.passes.recognise import RECOGNISE
from mn_onnx.ir.spec import CANONICAL, InvalidNetwork, verify


def canonical(network: Network, **options) -> Canonical:
    lower, upper = unit_box(network)
    return canonicalize(network, lower=lower, upper=upper, **options)


def over(network: Network, function, weight: float = 1.0, bias: float = 0.0) -> Network:
    """``weight * function(network) + bias``."""
    head = Unit(network.output, (function,), "head")
    output = AffineRow(np.array([network.n_variables]), np.array([weight]), bias)
    return replace(network, units=(*network.units, head), output=output)


@settings(max_examples=100, deadline=None)
@given(networks())
def test_exact_networks_keep_their_values(network: Network) -> None:
    """Head stripping apart, which changes values, canonical networks compute what they came from."""
    program = Program(network, *unit_box(network))
    kept = tuple(step for step in PASSES if step.name != "strip monotone heads")
    result, steps = run_passes(program, kept)
    verify(result.network, CANONICAL, "in the test")
    points = random_points(network, 100)
    np.testing.assert_allclose(evaluate(result.network, points), evaluate(network, points), rtol=1e-10, atol=1e-10)
    assert [step.name for step in steps] == [step.name for step in kept]


@settings(max_examples=40, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH), st.floats(-0.5, 0.5))
def test_level_set_and_orientation_are_kept(network: Network, level: float) -> None:
    """The canonical value has the sign of the original value minus the level, by true functions."""
    result = canonical(network, level=level, knots_per_period=2)
    points = random_points(network, 200)
    original = evaluate(network, points) - level
    stripped = evaluate(result.network, points, true_functions=True)
    clear = np.abs(original) > 1e-9
    if result.empty_reason:
        assert np.unique(np.sign(original[clear])).size <= 1
    np.testing.assert_array_equal(np.sign(original[clear]), np.sign(stripped[clear]))


@settings(max_examples=20, deadline=None)
@given(networks(PIECEWISE_LINEAR + SMOOTH))
def test_canonical_form_is_a_fixed_point(network: Network) -> None:
    first = canonical(network, knots_per_period=2)
    again, steps = run_passes(Program(first.network, first.lower, first.upper), LOWERING)
    changed = [step.name for step in steps if step.modified]
    assert changed == []
    assert again.network is first.network or len(again.network.units) == len(first.network.units)


HEADS = {
    "tanh": (TANH, 1), "negated tanh": (apply("tanh", apply("negate", T)), -1),
    "sigmoid": (apply("sigmoid", T), 1), "softplus": (softplus(1.0), 1), "leaky": (LEAKY, 1), "clip": (CLIP, 1),
    "elu": (ELU, 1), "scaled": (AFFINE, None),
    "tanh of clip": (apply("tanh", apply("minimum", T, constant(0.6))), 1),
    "exp": (apply("exp", apply("negate", T)), -1),
}  # fmt: skip


@pytest.mark.parametrize("name", HEADS)
@pytest.mark.parametrize("weight", [1.0, -2.0])
def test_monotone_heads_are_stripped_exactly(name: str, weight: float) -> None:
    function, direction = HEADS[name]
    inner = dense([10, 8], seed=7)
    network = over(inner, function, weight, 0.1)
    level = float(np.median(evaluate(network, random_points(network, 1001))))
    result = canonical(network, level=level)
    assert not result.empty_reason
    assert len(result.network.units) == 18, "the head is gone"
    assert result.is_exact
    if direction is not None:
        assert result.sign == direction * np.sign(weight)
    points = random_points(network, 500, seed=9)
    original, stripped = evaluate(network, points) - level, evaluate(result.network, points)
    clear = np.abs(original) > 1e-12
    np.testing.assert_array_equal(np.sign(original[clear]), np.sign(stripped[clear]))


def test_sigmoid_at_one_half_is_zero_before_it() -> None:
    inner = dense([10], seed=1)
    result = canonical(over(inner, apply("sigmoid", T)), level=0.5)
    assert result.network.output.bias == inner.output.bias


def test_stacked_heads_are_stripped_one_after_the_other() -> None:
    inner = dense([10], seed=1)
    network = over(over(inner, TANH, -3.0, 0.2), apply("sigmoid", T))
    result = canonical(network, level=0.6)
    assert result.heads == tuple(unit.name for unit in reversed(network.units[-2:]))
    assert result.sign == -1
    assert len(result.network.units) == 10
    points = random_points(network, 300)
    np.testing.assert_array_equal(np.sign(evaluate(network, points) - 0.6), np.sign(evaluate(result.network, points)))


@pytest.mark.parametrize(
    ("function", "level", "reason"),
    [
        (TANH, 3.0, r"head: the level 3 is not reached: values on its range over the box lie between"),
        (apply("sigmoid", T), 0.0, "head: the level 0 is not reached"),
        (apply("sigmoid", apply("multiply", constant(1e4), T)), 1.0, "head: the level 1 is not reached"),
        (CLIP, 0.75, "head: the level 0.75 is not reached: values lie between -0.5 and 0.5 only"),
    ],
)
def test_levels_out_of_a_head_s_range_are_told(function, level: float, reason: str) -> None:
    result = canonical(over(dense([10], seed=1), function), level=level)
    assert reason in result.empty_reason
    verify(result.network, CANONICAL, "in the test")


def test_clip_at_its_own_bound_and_other_heads_stay() -> None:
    inner = dense([10], seed=1)
    for function, level in ((CLIP, 0.5), (KnotTable.exact([0.0], [[-1.0, 1.0]], [[0.0, 0.0]]), 0.25), (SINE, 0.1)):
        result = canonical(over(inner, function), level=level)
        assert not result.empty_reason
        assert not result.heads
        assert len(result.network.units) == 11


def test_positional_encoding_becomes_one_unit_per_coordinate() -> None:
    units = []
    for axis in range(3):
        for octave in range(4):
            row = AffineRow(np.array([axis]), np.array([2.0**octave * np.pi]), 0.0)
            units += [Unit(row, (apply(op, T),), f"{op}{octave}[{axis}]") for op in ("sin", "cos")]
    encoding = Network(3, tuple(units), AffineRow(np.arange(27), np.linspace(-1, 1, 27), 0.0))
    result = canonical(encoding)
    assert [unit.n_outputs for unit in result.network.units] == [8, 8, 8]
    points = random_points(encoding, 300)
    np.testing.assert_allclose(
        evaluate(result.network, points, true_functions=True), evaluate(encoding, points), atol=1e-13
    )
    assert np.abs(evaluate(result.network, points) - evaluate(encoding, points)).max() <= result.surrogate_eps
    for unit in result.network.units:
        assert not np.isin([-1.0, 1.0], unit.table.knots).any(), "no knot plane coincides with a face of the box"


def test_opposite_and_shifted_units_share_a_unit() -> None:
    """``relu(t) - relu(-t)`` is ``t``; ``relu(2 t - 1)`` has a parallel plane."""
    row = AffineRow(np.array([0, 1]), np.array([0.6, -0.8]), 0.3)
    opposite = AffineRow(row.columns, -row.weights, -row.bias)
    shifted = AffineRow(row.columns, 2 * row.weights, 2 * row.bias - 1)
    other = AffineRow(row.columns, np.array([0.6, 0.8]), 0.3)
    rows = [row, opposite, shifted, other, row]
    units = tuple(Unit(r, (RELU,), f"unit{i}") for i, r in enumerate(rows))
    network = Network(2, units, AffineRow(np.arange(2, 7), np.array([1.0, -1.0, 0.5, 0.25, 2.0]), 0.0))
    result = canonical(network)
    assert [unit.n_outputs for unit in result.network.units] == [3, 1]
    np.testing.assert_allclose(result.network.units[0].table.knots, [0.0, 0.5], atol=1e-16)
    assert result.network.units[0].name == "unit0 (+3)"
    points = random_points(network, 200)
    np.testing.assert_allclose(evaluate(result.network, points), evaluate(network, points), atol=1e-14)


def test_duplicates_that_cancel_leave_a_constant() -> None:
    """A deeper row over the difference of two equal units reads nothing."""
    row = AffineRow(np.array([0, 1]), np.array([1.0, 2.0]), 0.5)
    units = [Unit(row, (RELU,), f"twin{i}") for i in range(2)]
    units += [Unit(AffineRow(np.array([2, 3]), np.array([1.0, -1.0]), 0.75), (TANH,), "nothing")]
    network = Network(2, tuple(units), AffineRow(np.array([1, 2, 4]), np.array([1.0, -1.0, 2.0]), 0.0))
    result = canonical(network)
    assert [unit.name for unit in result.network.units] == ["twin0 (+1)"]
    assert result.network.output.bias == pytest.approx(2 * np.tanh(0.75))


def test_a_head_spelled_with_two_units_is_stripped() -> None:
    """``relu(t) - 0.1 relu(-t)`` is a leaky ReLU."""
    inner = dense([6], seed=3)
    opposite = AffineRow(inner.output.columns, -inner.output.weights, -inner.output.bias)
    units = (*inner.units, Unit(inner.output, (RELU,), "plus"), Unit(opposite, (RELU,), "minus"))
    output = AffineRow(np.array([inner.n_variables, inner.n_variables + 1]), np.array([1.0, -0.1]), 0.0)
    result = canonical(replace(inner, units=units, output=output), level=0.02)
    assert len(result.network.units) == 6
    assert result.network.output.bias == pytest.approx(inner.output.bias - 0.02)


def test_nearly_proportional_rows_stay_apart() -> None:
    rows = [AffineRow(np.array([0, 1]), np.array([1.0, 1.0 + shift]), 0.1) for shift in (0.0, 1e-9)]
    units = tuple(Unit(row, (RELU,), f"unit{i}") for i, row in enumerate(rows))
    network = Network(2, units, AffineRow(np.array([2, 3]), np.array([1.0, 1.0]), 0.0))
    assert len(canonical(network).network.units) == 2


def test_affine_units_and_constants_disappear() -> None:
    """Two linear layers in a row are one; a unit of a constant is a number."""
    units = [Unit(AffineRow(np.array([0, 1]), np.array([1.0, 2.0]), 0.5), (AFFINE,), "linear")]
    units += [Unit(AffineRow(np.zeros(0, np.int64), np.zeros(0), 0.75), (STAIRS, TANH), "constant")]
    units += [Unit(AffineRow(np.array([2, 3, 4]), np.array([1.0, 1.0, 2.0]), 0.0), (RELU,), "relu")]
    network = Network(2, tuple(units), AffineRow(np.array([1, 5]), np.array([1.0, -1.0]), 0.0))
    result = canonical(network)
    assert [unit.name for unit in result.network.units] == ["relu"]
    row = result.network.units[0].row
    np.testing.assert_allclose(row.weights, [-1.5, -3.0])
    assert row.bias == pytest.approx(-1.5 * 0.5 + 0.25 + 0.5 + 2 * np.tanh(0.75))


def test_terms_that_cancel_leave_no_weight() -> None:
    third = 1.0 / 3.0
    linear = Unit(
        AffineRow(np.array([0, 1]), np.array([third, 1.0]), 0.0), (KnotTable.exact([], [[3.0]], [[0.0]]),), "a"
    )
    relu = Unit(AffineRow(np.array([0, 2]), np.array([-3 * third, 1.0]), 0.0), (RELU,), "b")
    network = Network(2, (linear, relu), AffineRow(np.array([3]), np.array([1.0]), -0.1))
    program, _ = run_passes(Program(network, *unit_box(network)), (RECOGNISE, FUSE_AFFINE))
    np.testing.assert_array_equal(program.network.units[0].row.columns, [1])


def test_expressions_that_are_piecewise_linear_become_exact() -> None:
    network = dense([6, 6], RELU_EXPRESSION)
    result = canonical(network)
    assert result.is_exact
    assert result.surrogate_eps == 0.0


def test_unused_units_and_outputs_are_removed() -> None:
    row = AffineRow(np.array([0]), np.array([1.0]), 0.0)
    units = (Unit(row, (RELU, STAIRS), "half"), Unit(row, (CLIP,), "unread"))
    network = Network(1, units, AffineRow(np.array([0, 2]), np.array([1.0, 1.0]), 0.0))
    result = canonical(network)
    assert [unit.n_outputs for unit in result.network.units] == [1]
    np.testing.assert_array_equal(result.network.units[0].table.knots, STAIRS.knots)


@pytest.mark.parametrize(("scale", "offset"), [(2.0, 0.3), (-0.7, 1.1)])
@pytest.mark.parametrize("function", [STAIRS, RELU, ELU, SILU])
def test_change_of_variable(function, scale: float, offset: float) -> None:
    s = np.linspace(-3, 3, 301)
    np.testing.assert_allclose(
        scalar_values(in_terms_of(function, scale, offset), s), scalar_values(function, scale * s + offset), atol=1e-14
    )


def test_failing_pass_names_the_unit_and_the_passes_before() -> None:
    network = dense([3], apply("floor", apply("multiply", constant(5.0), T)))
    with pytest.raises(PassFailed, match=r"pass 'tabulate' failed .*: layer0\[0\] and 2 more: its function jumps"):
        canonical(network)
    with pytest.raises(PassFailed, match="invalid before the pass 'merge proportional units'"):
        run_passes(Program(dense([2], AFFINE), -np.ones(3), np.ones(3)), (MERGE_PROPORTIONAL,))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": np.nan}, "level"),
        ({"knots_per_period": 0.5}, "knots_per_period"),
        ({"surrogate_tol": 0.0}, "positive"),
    ],
)
def test_invalid_options_are_refused(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        canonical(dense([2]), **options)


def _broken(**changes) -> Network:
    network = dense([3])
    return replace(network, units=(replace(network.units[0], **changes), *network.units[1:]))


NAN_ROW = AffineRow(np.array([0]), np.array([np.nan]), 0.0)
LATE_ROW = AffineRow(np.array([4]), np.array([1.0]), 0.0)
UNSORTED = KnotTable.exact([1.0, 0.0], [[0.0, 1.0, 0.0]], [[0.0, 0.0, 0.0]])
JUMP = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.5]])
SHORT = KnotTable(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
NEGATIVE = KnotTable(np.zeros(0), np.zeros((1, 1)), np.zeros((1, 1)), -np.ones((1, 1)))


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"row": NAN_ROW}, "not finite"),
        ({"row": LATE_ROW}, r"must increase and lie in 0\.\.2"),
        ({"functions": (UNSORTED,)}, "strictly increasing"),
        ({"functions": (JUMP,)}, "not continuous"),
        ({"functions": (SHORT,)}, r"shape \[1, 2\]"),
        ({"functions": (NEGATIVE,)}, "must not be negative"),
        ({"functions": ()}, "no function"),
    ],
)
def test_networks_against_the_grammar_are_refused(changes, fault: str) -> None:
    with pytest.raises(InvalidNetwork, match=rf"invalid as imported:\n  layer0\[0\]: .*{fault}"):
        canonical(_broken(**changes))


def test_every_canonical_property_is_checked() -> None:
    """An imported network with one defect of each kind violates the canonical grammar in each way."""
    row = AffineRow(np.array([0]), np.array([1.0]), 0.0)
    empty = AffineRow(np.zeros(0, np.int64), np.zeros(0), 1.0)
    units = (Unit(row, (RELU,), "a"), Unit(row, (RELU,), "b"), Unit(empty, (RELU,), "c"))
    network = Network(1, units, AffineRow(np.array([1, 2]), np.array([1.0, 1.0]), 0.0))
    with pytest.raises(InvalidNetwork) as caught:
        verify(network, CANONICAL[:3] + CANONICAL[4:], "here")
    for fault in ("c: it is affine", "c: one of its outputs is never read", "a: it has no table"):
        assert fault in str(caught.value)
    with pytest.raises(InvalidNetwork, match="a, b: their pre-activations are proportional"):
        verify(replace(network, units=units[:2]), CANONICAL[3:4], "here")


def test_wide_networks_are_canonicalised_in_about_a_second() -> None:
    network = dense([512] * 4)
    started = time.process_time()
    result = canonical(network)
    assert time.process_time() - started < 8.0, "0.6 s on a quiet core"
    assert len(result.network.units) == 2048
