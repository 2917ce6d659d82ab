"""The dump of a network that people read."""

from __future__ import annotations

import numpy as np
from ir_networks import CLIP, ELU, RELU, TANH, dense

from mn_onnx.ir.network import AffineRow, Network, Unit
from mn_onnx.ir.passes import canonicalize
from mn_onnx.ir.text import dump, expression_text


def test_small_network_reads_as_formulas() -> None:
    units = (
        Unit(AffineRow(np.array([0, 1]), np.array([1.0, -0.5]), 0.25), (RELU, CLIP), "first"),
        Unit(AffineRow(np.array([1, 3]), np.array([2.0, 1.0]), 0.0), (TANH,), "second"),
    )
    network = Network(2, units, AffineRow(np.array([2, 4]), np.array([1.0, 3.0]), -1.0), "sdf", {"producer": "test"})
    assert dump(network).splitlines() == [
        "network of 2 inputs, 2 units, 0 knots, 6 weights",
        "  producer: test",
        "  level 0: 1 units over 2 variables",
        "    u0 'first': t = 0.25 +1 x0 -0.5 x1",
        "      u0.0 = 0 | t < 0; t | t >= 0",
        "      u0.1 = -0.5 | t < -0.5; t | t >= -0.5; 0.5 | t >= 0.5",
        "  level 1: 1 units over 2 variables",
        "    u1 'second': t = 0 +2 x1 +1 u0.1",
        "      u1 = tanh(t)",
        "  output 'sdf' = -1 +1 u0.0 +3 u1",
    ]


def test_long_rows_and_tables_are_shortened() -> None:
    network = canonicalize(dense([12, 2], TANH), lower=-np.ones(3), upper=np.ones(3)).network
    short, full = dump(network), dump(network, full=True)
    assert "... (6 more)" in short
    assert "knots in [" in short
    assert "..." not in full
    assert len(full) > 2 * len(short)


def test_expressions_read_as_formulas() -> None:
    assert expression_text(ELU) == "where((0 < t), t, (exp(t) - 1))"
