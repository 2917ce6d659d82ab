"""Proved errors of polygons against what sampling finds."""

from __future__ import annotations

import numpy as np
import pytest
from ir_networks import ELU, RELU, SILU, SINE, dense, softplus
from smooth_models import HIGH, LOW, extracted

from mn_onnx.extract.smooth import face_errors
from mn_onnx.extract.smooth.face_errors import polygon_errors, surface_errors
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.passes import canonicalize

PER_POLYGON = 40
SMALL_BOX = (np.full(3, -0.25), np.full(3, 0.25))


def largest_differences(network: Network, surface: Surface) -> Floats:
    """The largest |f_true - f| seen at corners and random points of each polygon, [p]."""
    rng = np.random.default_rng(0)
    points = []
    for begin, end in zip(surface.offsets[:-1], surface.offsets[1:], strict=True):
        corners = surface.vertices[surface.corners[begin:end]]
        inside = rng.dirichlet(np.full(len(corners), 0.5), PER_POLYGON - 1)
        points.append(np.concatenate([inside @ corners, corners[:1]]))
    together = np.concatenate(points)
    difference = np.abs(evaluate(network, together, true_functions=True) - evaluate(network, together))
    return np.asarray(difference.reshape(-1, PER_POLYGON).max(axis=1))


@pytest.mark.parametrize("function", [SINE, SILU, ELU, softplus(20.0)], ids=["sine", "silu", "elu", "softplus"])
@pytest.mark.parametrize("knots", [3.0, 6.0])
def test_bounds_hold_and_are_close(function: Expression, knots: float) -> None:
    low, high = SMALL_BOX if function is SINE else (LOW, HIGH)
    canonical, surface = extracted(dense([5, 5, 4], function, seed=2), knots=knots, lower=low, upper=high)
    assert surface.n_polygons > 4
    errors = surface_errors(canonical.network, surface, low, high, threads=1)
    seen = largest_differences(canonical.network, surface)
    assert (seen <= errors).all()
    assert np.median(errors / seen) < 10


def test_threads_do_not_change_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mn_onnx.extract.smooth.face_errors.BLOCK", 64)
    low, high = SMALL_BOX
    canonical, surface = extracted(dense([37, 35], SINE, seed=3), knots=2.5, lower=0.4 * low, upper=0.4 * high)
    assert surface.n_polygons > 64 * 16
    found = [surface_errors(canonical.network, surface, low, high, threads=threads) for threads in (1, 2, 3)]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_exact_networks_have_no_error() -> None:
    canonical, surface = extracted(dense([6, 6], RELU, seed=1), knots=8)
    assert not surface_errors(canonical.network, surface, LOW, HIGH).any()


def test_segments_in_two_dimensions() -> None:
    network = dense([6], SINE, seed=5, dimension=2)
    table = canonicalize(network, lower=LOW[:2], upper=HIGH[:2], knots_per_period=6).network
    ends = np.array([[0.21, -0.4], [0.23, -0.38]])
    error = polygon_errors(table, ends, np.array([0, 2]), np.array([0, 1]), LOW[:2], HIGH[:2])
    along = np.linspace(0.0, 1.0, 101)[:, None]
    seen = np.abs(evaluate(table, (1 - along) * ends[0] + along * ends[1], true_functions=True)).max()
    assert seen <= error
    assert error < 1.01 * seen


@pytest.mark.parametrize("sizes", [1, 8, 64])
def test_bounds_hold_on_patches_of_any_size(sizes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face_errors, "SMALLEST_PATCH", sizes)
    monkeypatch.setattr(face_errors, "LARGEST_PATCH", sizes)
    monkeypatch.setattr(face_errors, "CHEAP", 1)
    canonical, surface = extracted(dense([6, 5], SINE, seed=4), knots=4, lower=SMALL_BOX[0], upper=SMALL_BOX[1])
    assert surface.n_polygons > 64
    errors = surface_errors(canonical.network, surface, *SMALL_BOX, threads=1)
    assert (largest_differences(canonical.network, surface) <= errors).all()


def test_bounds_do_not_need_polygons_of_the_surrogates() -> None:
    canonical, _ = extracted(dense([6, 5], softplus(10.0), seed=6), knots=3)
    rng = np.random.default_rng(1)
    corners = rng.uniform(-0.7, 0.7, (300, 1, 3)) + rng.uniform(-0.2, 0.2, (300, 3, 3))
    errors = polygon_errors(
        canonical.network, corners.reshape(-1, 3), np.arange(0, 901, 3), np.arange(900), LOW, HIGH, threads=1
    )
    inside = np.einsum("sk,pkd->psd", rng.dirichlet(np.ones(3), PER_POLYGON), corners)
    values = evaluate(canonical.network, inside.reshape(-1, 3), true_functions=True).reshape(300, PER_POLYGON)
    assert (np.abs(values).max(axis=1) <= errors).all()


def test_bounds_hardly_depend_on_the_order_of_polygons() -> None:
    canonical, surface = extracted(dense([5, 5], SILU, seed=7), knots=6)
    alone = surface_errors(canonical.network, surface, LOW, HIGH, threads=1)
    shuffled = np.random.default_rng(2).permutation(surface.n_polygons)
    sizes = surface.polygon_sizes[shuffled]
    corners = np.concatenate([surface.corners[surface.offsets[k] : surface.offsets[k + 1]] for k in shuffled])
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    found = polygon_errors(canonical.network, surface.vertices, offsets, corners, LOW, HIGH, threads=1)
    assert np.median(found / alone[shuffled]) == pytest.approx(1, rel=0.1)
