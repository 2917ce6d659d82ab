"""Functions that are only defined on a part of the line, on data that stay there."""

from __future__ import annotations

import numpy as np
import pytest
from onnx_models import assert_agrees, float32, imported_values, model_of, node, points_in_box

from mn_onnx.importer import import_network

SMALL = 0.2 * np.tanh(float32(3, 6))
CONSTANTS = {"W": SMALL, "V": float32(6, 1)}


@pytest.mark.parametrize(
    ("op", "shift"),
    [
        ("Log", 1.0),
        ("Sqrt", 1.0),
        ("Reciprocal", 1.0),
        ("Tan", 0.0),
        ("Asin", 0.0),
        ("Acos", 0.0),
        ("Acosh", 2.0),
        ("Atanh", 0.0),
    ],
)
def test_functions_on_their_domain(op: str, shift: float) -> None:
    nodes = [
        node("MatMul", ["x", "W"], ["p"]),
        node("Add", ["p", "shift"], ["q"]),
        node(op, ["q"], ["h"]),
        node("MatMul", ["h", "V"], ["y"]),
    ]
    assert_agrees(model_of(nodes, CONSTANTS | {"shift": np.float32(shift)}))


def test_reduce_log_sum() -> None:
    nodes = [
        node("MatMul", ["x", "W"], ["p"]),
        node("Add", ["p", "one"], ["q"]),
        node("ReduceLogSum", ["q"], ["y"], axes=[1]),
    ]
    assert_agrees(model_of(nodes, CONSTANTS | {"one": np.float32(1)}, opset=13))


def test_product_of_powers_of_one_row() -> None:
    """ReduceProd over copies of one number is its power."""
    nodes = [
        node("MatMul", ["x", "V"], ["p"]),
        node("Concat", ["p", "p", "p"], ["t"], axis=1),
        node("ReduceProd", ["t"], ["y"], axes=[1]),
    ]
    imported = assert_agrees(model_of(nodes, {"V": float32(3, 1)}, opset=13))
    assert len(imported.network.units) == 1


def test_swish_of_opset_24() -> None:
    """Newer than most runtimes, so the formula is checked itself."""
    nodes = [
        node("MatMul", ["x", "W"], ["p"]),
        node("Swish", ["p"], ["h"], alpha=1.5),
        node("MatMul", ["h", "V"], ["y"]),
    ]
    points = points_in_box(3)
    p = points @ SMALL.astype(np.float64)
    expected = (p / (1 + np.exp(-1.5 * p))) @ CONSTANTS["V"].astype(np.float64)
    actual = imported_values(import_network(model_of(nodes, CONSTANTS, opset=24)), points)
    np.testing.assert_allclose(actual, expected[:, 0], rtol=0, atol=1e-12)


def test_transpose_matmul_is_fused_matmul() -> None:
    nodes = [
        node("TransposeMatMul", ["x", "W"], ["p"], domain="com.microsoft", transB=1, alpha=0.5),
        node("Relu", ["p"], ["h"]),
        node("MatMul", ["h", "V"], ["y"]),
    ]
    weights = float32(6, 3)
    model = model_of(nodes, {"W": weights, "V": CONSTANTS["V"]}, domains=["com.microsoft"])
    points = points_in_box(3)
    expected = np.maximum(0.5 * points @ weights.T.astype(np.float64), 0) @ CONSTANTS["V"].astype(np.float64)
    np.testing.assert_allclose(imported_values(import_network(model), points), expected[:, 0], rtol=0, atol=1e-12)
