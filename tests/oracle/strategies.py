"""Hypothesis strategies for random tiny networks that the oracle can enumerate within a second."""

from __future__ import annotations

from hypothesis import strategies as st

from mn_onnx.ir.network import Network
from oracle.random_networks import ACTIVATIONS, RandomNetwork, random_tables

SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def random_networks(draw: st.DrawFn, dimension: int = 3, max_width: int = 4) -> RandomNetwork:
    """Networks of one to three layers with any activations, the level in the middle of the values."""
    layer = st.tuples(st.sampled_from(ACTIVATIONS), st.integers(2, max_width))
    layers = draw(st.lists(layer, min_size=1, max_size=3))
    return RandomNetwork(dimension, tuple(layers), draw(st.booleans()), draw(SEEDS)).centred()


@st.composite
def random_table_networks(draw: st.DrawFn) -> Network:
    """Networks whose units have several knots and outputs, in one or two layers."""
    layers = draw(st.lists(st.integers(1, 3), min_size=1, max_size=2))
    return random_tables(draw(SEEDS), layers, n_knots=draw(st.integers(1, 4)), n_outputs=draw(st.integers(1, 3)))
