"""Fit a tiny network with positional encoding to the signed distance of a circle, and export it to ONNX.

python models/fit_circle.py models/circle_pe2_d2_w4.onnx

The network of the experiment in section 5.7 of Stippel et al., "Marching Neurons", ACM TOG 44(6), 2025: sines and
cosines of two frequencies, two layers of four ReLU neurons. `circle_knots.py` shows what knots do to it.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Floats = NDArray[np.float64]

RADIUS = 0.6
FREQUENCIES = 2
WIDTH = 4
POINTS = 4096
STEPS = 4000
RESTARTS = 8
LEARNING_RATE = 0.02
DECAYS = (0.9, 0.999)


def encode(points: Floats) -> Floats:
    """Sines and cosines of ``2**k pi x``, float64 [n, 4 * FREQUENCIES]."""
    phases = np.concatenate([2.0**k * np.pi * points for k in range(FREQUENCIES)], axis=1)
    return np.concatenate([np.sin(phases), np.cos(phases)], axis=1)


def gradients(weights: list[Floats], features: Floats, distances: Floats) -> tuple[float, list[Floats]]:
    """The mean squared error of the network, and its derivatives by ``weights``: matrices and biases by turns."""
    layers = [features]
    for matrix, bias in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        layers.append(np.maximum(layers[-1] @ matrix + bias, 0.0))
    error = (layers[-1] @ weights[-2] + weights[-1])[:, 0] - distances
    adjoint = (2 / len(error) * error)[:, None]
    found: list[Floats] = []
    for layer in range(len(layers) - 1, -1, -1):
        found = [layers[layer].T @ adjoint, adjoint.sum(axis=0), *found]
        adjoint = (adjoint @ weights[2 * layer].T) * (layers[layer] > 0)
    return float((error**2).mean()), found


def fit(generator: np.random.Generator) -> tuple[float, list[Floats]]:
    """The error and weights of one network, trained with Adam (Kingma & Ba 2015) from a random start."""
    sizes = [4 * FREQUENCIES, WIDTH, WIDTH, 1]
    weights: list[Floats] = []
    for inputs, outputs in pairwise(sizes):
        weights += [generator.normal(scale=np.sqrt(2 / inputs), size=(inputs, outputs)), np.zeros(outputs)]
    points = generator.uniform(-1, 1, (POINTS, 2))
    features, distances = encode(points), np.hypot(*points.T) - RADIUS
    means, squares = [np.zeros_like(w) for w in weights], [np.zeros_like(w) for w in weights]
    error = np.inf
    for step in range(1, STEPS + 1):
        error, found = gradients(weights, features, distances)
        rate = LEARNING_RATE * 0.5 * (1 + np.cos(np.pi * step / STEPS))
        for index, gradient in enumerate(found):
            means[index] += (1 - DECAYS[0]) * (gradient - means[index])
            squares[index] += (1 - DECAYS[1]) * (gradient**2 - squares[index])
            mean, square = means[index] / (1 - DECAYS[0] ** step), squares[index] / (1 - DECAYS[1] ** step)
            weights[index] = weights[index] - rate * mean / (np.sqrt(square) + 1e-8)
    return error, weights


def to_onnx(weights: list[Floats]) -> onnx.ModelProto:
    """The network as an ONNX model of points ``xy`` float32 [N, 2] to ``distance`` [N, 1]."""
    scales = [2.0**k * np.pi for k in range(FREQUENCIES)]
    phases = np.concatenate([scale * np.eye(2) for scale in scales], axis=1)
    nodes = [
        helper.make_node("MatMul", ["xy", "phases"], ["phase"], name="encoding/phase"),
        helper.make_node("Sin", ["phase"], ["sin"], name="encoding/sin"),
        helper.make_node("Cos", ["phase"], ["cos"], name="encoding/cos"),
        helper.make_node("Concat", ["sin", "cos"], ["h0"], name="encoding", axis=1),
    ]
    constants = {"phases": phases}
    last = len(weights) // 2 - 1
    for layer in range(last + 1):
        constants[f"w{layer}"], constants[f"b{layer}"] = weights[2 * layer], weights[2 * layer + 1]
        out = "distance" if layer == last else f"t{layer}"
        nodes.append(helper.make_node("Gemm", [f"h{layer}", f"w{layer}", f"b{layer}"], [out], name=f"layer{layer}"))
        if layer < last:
            nodes.append(helper.make_node("Relu", [out], [f"h{layer + 1}"], name=f"relu{layer}"))
    graph = helper.make_graph(
        nodes,
        "circle",
        [helper.make_tensor_value_info("xy", TensorProto.FLOAT, ["N", 2])],
        [helper.make_tensor_value_info("distance", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def main(target: str) -> None:
    """Write the best of some networks to ``target``."""
    generator = np.random.default_rng(0)
    error, weights = min((fit(generator) for _ in range(RESTARTS)), key=lambda result: result[0])
    onnx.save(to_onnx(weights), Path(target))
    print(f"{target}: root mean square error {np.sqrt(error):.4f}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
