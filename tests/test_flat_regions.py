"""The search for regions of zeros evaluates on threads of ours, and the same on any number of them."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from mn_onnx.extract.degeneracy import flat
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.weld import weld
from mn_onnx.ir.evaluator import Evaluator
from oracle.random_networks import random_tables

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)


@pytest.mark.parametrize("threads", [1, 2])
def test_matrices_are_multiplied_on_the_threads_given(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """numpy's own threads would still be busy when the next traversal begins."""
    network = random_tables(6, (8, 8), n_knots=6, n_outputs=3)
    surface = weld(traverse(network, LOWER, UPPER, threads=1)[0])
    pools: list[int] = []
    values = Evaluator.values

    def recorded(evaluator: Evaluator, points: np.ndarray) -> np.ndarray:
        pools.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return values(evaluator, points)

    monkeypatch.setattr(Evaluator, "values", recorded)
    found = flat.find_flat_regions(network, LOWER, UPPER, surface, threads=threads)
    assert found == flat.FlatRegions()
    assert len(pools) >= flat.N_INSIDE // flat.BLOCK
    assert set(pools) == {1}


def test_values_do_not_depend_on_threads() -> None:
    evaluator = Evaluator(random_tables(6, (8, 8), n_knots=6, n_outputs=3))
    points = np.random.default_rng(2).uniform(-1, 1, (3 * flat.BLOCK + 7, 3))
    expected = flat._values(evaluator, points, 1)
    np.testing.assert_array_equal(flat._values(evaluator, points, 2), expected)
    np.testing.assert_allclose(expected, evaluator.values(points), rtol=1e-12, atol=1e-12)
