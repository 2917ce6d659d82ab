"""Evaluation of networks and their gradients in float64, the reference that everything is compared with."""

from __future__ import annotations

from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.ir.network import Floats, Network
from mn_onnx.ir.rounding import float64_error_bound, rounding_error_bound, rounding_error_bounds

__all__ = [
    "evaluate",
    "float64_error_bound",
    "gradient",
    "rounding_error_bound",
    "rounding_error_bounds",
]


def evaluate(network: Network, points: Floats, *, true_functions: bool = False) -> Floats:
    """``f`` at ``points`` (float64 [n, input_dim]), float64 [n].

    Units are evaluated by their tables where they have one; with ``true_functions`` always by their true functions.
    Raises ``ValueError`` for points of another dimension.
    """
    return Evaluator(network, true_functions=true_functions).values(points)


def gradient(network: Network, points: Floats, *, true_functions: bool = False) -> Floats:
    """The gradient of ``f`` at ``points`` (float64 [n, input_dim]), float64 [n, input_dim].

    At a knot it is the gradient on the knot's right side (larger pre-activation). Raises ``ValueError`` as `evaluate`.
    """
    return Evaluator(network, true_functions=true_functions).gradients(points)
