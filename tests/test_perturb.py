import numpy as np
import pytest

from mn_onnx.extract.degeneracy.perturb import perturbation
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import AffineRow, Network, Unit
from oracle.random_networks import RandomNetwork
from oracle.sketch import as_network

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
NETWORK = as_network(RandomNetwork(3, (("relu", 8), ("abs", 6), ("maximum", 4)), True, 3).centred())


def test_the_same_arguments_give_the_same_shifts():
    one, again = (perturbation(NETWORK, LOWER, UPPER, size=1e-9, seed=4) for _ in range(2))
    np.testing.assert_array_equal(one.units, again.units)
    assert one.output == again.output
    other = perturbation(NETWORK, LOWER, UPPER, size=1e-9, seed=5)
    assert not np.isin(other.units, one.units).any()


def test_shifts_are_in_proportion_to_size_and_all_different():
    small, large = (perturbation(NETWORK, LOWER, UPPER, size=size, seed=0) for size in (1e-10, 1e-9))
    np.testing.assert_allclose(large.units, 10 * small.units)
    assert np.unique(large.units).size == len(NETWORK.units)
    assert (large.units > 0).any()
    assert (large.units < 0).any()
    assert np.abs(large.units).max() < 1e-7


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("seed", range(5))
def test_the_perturbed_function_is_everywhere_larger(scale, seed):
    points = np.random.default_rng(99).uniform(LOWER, UPPER, (5000, 3))
    shifted = perturbation(NETWORK, LOWER, UPPER, size=1e-9, seed=seed).at(scale)
    rise = evaluate(shifted, points) - evaluate(NETWORK, points)
    assert rise.min() > 0
    assert rise.max() < 1e-6


def test_networks_that_are_not_canonical_are_refused():
    unit = Unit(AffineRow(np.arange(3), np.ones(3), 0.0), NETWORK.units[0].functions, "/act/Sin")
    with pytest.raises(ValueError, match="/act/Sin has no knot table"):
        perturbation(Network(3, (unit,), AffineRow(np.array([3]), np.ones(1), 0.0)), LOWER, UPPER, size=1e-9, seed=0)
