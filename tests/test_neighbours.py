"""The order of polygons in patches."""

from __future__ import annotations

import numpy as np
import pytest

from mn_onnx.extract.kernels.neighbours import order_by_halves


@pytest.mark.parametrize("n", [1, 2, 7, 64, 100, 1000])
@pytest.mark.parametrize("dimension", [2, 3])
def test_each_part_is_divided_across_its_longest_side(n: int, dimension: int) -> None:
    points = np.random.default_rng(n).normal(size=(n, dimension))
    order = np.arange(n)
    order_by_halves(points, order)
    assert (np.sort(order) == np.arange(n)).all()
    half = 1 << max(0, (n - 1).bit_length() - 1)
    axis = int(np.argmax(np.ptp(points, axis=0)))
    assert n == 1 or points[order[:half], axis].max() <= points[order[half:], axis].min()


def test_runs_are_compact() -> None:
    side = np.linspace(0.0, 1.0, 32)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.random.default_rng(0).permutation(grid)
    order = np.arange(len(points))
    order_by_halves(points, order)
    widths = np.ptp(points[order].reshape(-1, 16, 2), axis=1)
    np.testing.assert_allclose(widths, 3 / 31)


def test_equal_points_end() -> None:
    order = np.arange(4097)
    order_by_halves(np.zeros((4097, 3)), order)
    assert (np.sort(order) == np.arange(4097)).all()
