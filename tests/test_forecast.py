"""The expected number of polygons against what extraction finds, and what follows from it."""

from __future__ import annotations

import numpy as np
import pytest
from ir_networks import RELU, SINE, dense
from smooth_models import HIGH, LOW, extracted, soft_octahedron_model

from mn_onnx.errors import UsageError
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.forecast import forecast
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.ir.passes import Canonical
from mn_onnx.model import load
from mn_onnx.surrogates import Fineness, canonical_within_budget


def within(network: Network, budget: float | None, half: float = 1.0) -> tuple[Canonical, Fineness | None]:
    return canonical_within_budget(
        network,
        lower=LOW * half,
        upper=HIGH * half,
        level=0.0,
        surrogate_tol=None,
        knots_per_period=None,
        budget=budget,
    )


def encoded() -> Network:
    """Sines of the coordinates under a ReLU network, whose own knots are most of them."""
    encoding = [
        Unit(AffineRow(np.array([axis]), np.array([scale]), 0.1), (SINE,), f"encoding[{axis}]")
        for axis in range(3)
        for scale in (0.25, 0.5)
    ]
    above = dense([60, 60], RELU, seed=3, dimension=6)
    units = [*encoding]
    for unit in above.units:
        row = AffineRow(unit.row.columns + 3, unit.row.weights, unit.row.bias)
        units.append(Unit(row, unit.functions, unit.name))
    output = AffineRow(above.output.columns + 3, above.output.weights, above.output.bias)
    return Network(3, tuple(units), output)


@pytest.mark.parametrize(("function", "knots", "half"), [(RELU, 8.0, 1.0), (SINE, 4.0, 0.25), (SINE, 12.0, 0.25)])
def test_forecast_is_near_the_count(function: Expression | KnotTable, knots: float, half: float) -> None:
    canonical, surface = extracted(dense([12, 8], function, seed=4), knots=knots, lower=LOW * half, upper=HIGH * half)
    expected = forecast(canonical.network, LOW * half, HIGH * half)
    # A surface cut by the box has more polygons than vertices inside: those along the cut.
    assert 0.5 * surface.n_polygons < expected.pieces < 1.3 * surface.n_polygons
    assert expected.area == pytest.approx(surface.area, rel=0.1)


def test_a_gradient_that_vanishes_at_a_crossing_is_no_obstacle() -> None:
    """``max(x, 0) + min(x + 1/2, 0)`` has its zeros on ``[-1/2, 0]``, where it is constant."""
    table = KnotTable.exact([-0.5, 0.0], [[1.0, 0.0, 1.0]], [[0.5, 0.0, 0.0]])
    units = tuple(Unit(AffineRow(np.arange(3), row, 0.0), (table,), "clip", table) for row in np.eye(3))
    found = forecast(Network(3, units, AffineRow(np.arange(3, 6), np.ones(3), 0.0)), LOW, HIGH)
    assert np.isfinite(found.pieces)


def test_finer_surrogates_have_gradients_closer_to_the_true_ones() -> None:
    network = dense([12, 8], SINE, seed=4)
    angles = []
    for knots in (4.0, 12.0):
        canonical, _ = extracted(network, knots=knots, lower=LOW / 4, upper=HIGH / 4)
        angles.append(forecast(canonical.network, LOW / 4, HIGH / 4).angle)
    assert 0 < angles[1] < 0.5 * angles[0] < 45
    exact, _ = extracted(dense([12, 8], RELU, seed=4), knots=8)
    assert forecast(exact.network, LOW, HIGH).angle < 1e-5


def test_surrogates_are_as_fine_as_the_budget_allows() -> None:
    model = load(soft_octahedron_model(), bind={"code": [0.0]})
    assert model.fineness is not None
    assert model.fineness.knots_per_period == 16
    budget = model.fineness.forecast.pieces / 4
    less = load(soft_octahedron_model(), bind={"code": [0.0]}, budget=budget)
    assert less.fineness is not None
    assert less.fineness.knots_per_period is not None
    assert less.fineness.knots_per_period < 16
    assert less.fineness.forecast.pieces <= budget


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_the_budget_is_kept_where_most_knots_are_of_exact_functions(share: float) -> None:
    coarsest, finest = forecast_at(3.0), forecast_at(16.0)
    budget = coarsest + share * (finest - coarsest)
    fineness = within(encoded(), budget)[1]
    assert fineness is not None
    assert 0.75 * budget < fineness.forecast.pieces <= budget


def forecast_at(knots: float) -> float:
    _, fineness = canonical_within_budget(
        encoded(), lower=LOW, upper=HIGH, level=0.0, surrogate_tol=None, knots_per_period=knots, budget=None
    )
    assert fineness is not None
    return fineness.forecast.pieces


def test_a_budget_that_the_coarsest_surrogates_exceed_is_refused() -> None:
    budget = 0.5 * forecast_at(3.0)
    with pytest.raises(UsageError, match=r"even the coarsest surrogates give about [\d,]+ polygons.*--budget \d+"):
        within(encoded(), budget)


def test_what_costs_more_than_the_budget_is_told_before() -> None:
    with pytest.raises(UsageError, match=r"polygons.*budget is 10 polygons.*--budget \d+"):
        load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=16, budget=10)


def test_more_than_the_usual_number_of_polygons_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = 0.5 * forecast_at(3.0)
    monkeypatch.setattr("mn_onnx.surrogates.DEFAULT_BUDGET", usual)
    fineness = within(encoded(), None)[1]
    assert fineness is not None
    assert fineness.forecast.pieces > usual
    assert f"(beyond {usual:,.0f})" in fineness.cost(1)
    assert "polishing" not in fineness.cost(1)
    assert fineness.cost(1, polish=True).endswith("with polishing, which divides them")


def test_surrogates_are_finer_than_usual_where_the_topology_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    network = dense([12, 8], SINE, seed=4)
    free = within(network, None, half=0.25)[1]
    assert free is not None
    trusted = 2.0 * free.forecast.angle
    monkeypatch.setattr("mn_onnx.surrogates.TRUSTED_ANGLE", trusted)
    monkeypatch.setattr("mn_onnx.surrogates.DEFAULT_BUDGET", free.forecast.pieces / 20)
    asked = within(network, free.forecast.pieces / 20, half=0.25)[1]
    usual = within(network, None, half=0.25)[1]
    assert asked is not None
    assert usual is not None
    assert asked.forecast.angle > trusted
    assert asked.forecast.pieces < usual.forecast.pieces < free.forecast.pieces
    assert usual.forecast.angle <= 1.3 * trusted
