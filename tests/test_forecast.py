"""The expected number of polygons against what extraction finds, and what follows from it."""

from __future__ import annotations

import pytest
from ir_networks import RELU, SINE, dense
from smooth_models import HIGH, LOW, extracted, soft_octahedron_model

from mn_onnx.errors import UsageError
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.forecast import forecast
from mn_onnx.ir.network import KnotTable
from mn_onnx.model import load


@pytest.mark.parametrize(("function", "knots", "half"), [(RELU, 8.0, 1.0), (SINE, 4.0, 0.25), (SINE, 12.0, 0.25)])
def test_forecast_is_near_the_count(function: Expression | KnotTable, knots: float, half: float) -> None:
    canonical, surface = extracted(dense([12, 8], function, seed=4), knots=knots, lower=LOW * half, upper=HIGH * half)
    expected = forecast(canonical.network, LOW * half, HIGH * half)
    # A surface cut by the box has more polygons than vertices inside: those along the cut.
    assert 0.5 * surface.n_polygons < expected.pieces < 1.3 * surface.n_polygons
    assert expected.area == pytest.approx(surface.area, rel=0.1)


def test_surrogates_are_as_fine_as_the_budget_allows() -> None:
    model = load(soft_octahedron_model(), bind={"code": [0.0]})
    assert model.fineness is not None
    assert model.fineness.knots_per_period == 16
    less = load(soft_octahedron_model(), bind={"code": [0.0]}, budget=model.fineness.forecast.pieces / 4)
    assert less.fineness is not None
    assert less.fineness.knots_per_period is not None
    assert less.fineness.knots_per_period < 16
    assert less.fineness.forecast.pieces < model.fineness.forecast.pieces / 3.5


def test_what_costs_more_than_the_budget_is_told_before() -> None:
    with pytest.raises(UsageError, match=r"polygons.*budget of 10 polygons.*--budget \d+"):
        load(soft_octahedron_model(), bind={"code": [0.0]}, knots_per_period=16, budget=10)
