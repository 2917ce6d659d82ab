"""Lowering of operators outside the standard domain: fused ones of onnxruntime, and ai.onnx.ml."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from mn_onnx.ir.expression import Expression, apply, constant
from mn_onnx.lowering import formulas, linear, shape
from mn_onnx.lowering.activation import elementwise, number
from mn_onnx.lowering.context import Context
from mn_onnx.lowering.indexing import indices_of, wrapped
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.quantised import dequantize, matmul_of_packed_weights
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, concatenate, lift, rearrange
from mn_onnx.symbolic.linear import matmul

FLOAT32 = np.dtype(np.float32)


def fused_activation(node: Node, x: Expression) -> Expression:
    """The activation that onnxruntime fused behind a product."""
    name = node.attribute("activation", "")
    parameters = node.attribute("activation_params") or []

    def parameter(index: int, attribute: str, default: float) -> float:
        return float(parameters[index]) if index < len(parameters) else number(node, attribute, default)

    known: dict[str, Callable[[], Expression]] = {
        "": lambda: x,
        "Relu": lambda: formulas.positive_part(x),
        "LeakyRelu": lambda: formulas.leaky(x, parameter(0, "activation_alpha", 0.01)),
        "Clip": lambda: formulas.clip(
            x, parameter(0, "activation_min", -np.inf), parameter(1, "activation_max", np.inf)
        ),
        "HardSigmoid": lambda: formulas.hard_sigmoid(
            x, parameter(0, "activation_alpha", 0.2), parameter(1, "activation_beta", 0.5)
        ),
        "Elu": lambda: formulas.elu(x, parameter(0, "activation_alpha", 1.0)),
        "Sigmoid": lambda: apply("sigmoid", x),
        "Tanh": lambda: apply("tanh", x),
        "Softplus": lambda: apply("softplus", x),
        "Softsign": lambda: formulas.softsign(x),
        "HardSwish": lambda: formulas.hard_swish(x),
    }
    if name not in known:
        raise UnsupportedNode(
            f"its fused activation {name!r} is not supported", "optimise the model at a lower level (basic)"
        )
    return known[name]()


def fused_gemm(context: Context, node: Node) -> Tensor:
    """Gemm followed by an activation."""
    product = linear.gemm(context, node)
    return context.algebra.unary(lift(product), lambda x: fused_activation(node, x))


def fused_convolution(context: Context, node: Node) -> Tensor:
    """Convolution, an optional summand, and an activation."""
    plain = dataclasses.replace(node, inputs=node.inputs[:3])
    result = linear.convolution(context, plain)
    if node.has(3):
        result = context.algebra.add(result, lift(node.tensor(3)))
    return context.algebra.unary(result, lambda x: fused_activation(node, x))


def fused_matmul(context: Context, node: Node) -> Tensor:
    """``alpha * A' @ B'`` with optional transpositions, those of batch axes included."""
    operands = []
    for index, letter in enumerate("AB"):
        x = node.tensor(index)
        if node.attribute(f"transBatch{letter}", 0):
            x = rearrange(x, lambda array: np.moveaxis(array, 0, -2))
        if node.attribute(f"trans{letter}", 0) and len(x.shape) > 1:
            x = rearrange(x, lambda array: np.swapaxes(array, -1, -2))
        operands.append(x)
    return linear.scaled(context, matmul(context.algebra, operands[0], operands[1]), number(node, "alpha", 1.0))


def biased(formula: Callable[[Expression], Expression]) -> Callable[[Context, Node], Tensor]:
    """An activation of the sum of its input and an optional bias."""

    def lower(context: Context, node: Node) -> Tensor:
        x = lift(node.tensor(0))
        if node.has(1):
            x = context.algebra.add(x, lift(node.tensor(1)))
        return context.algebra.unary(x, formula)

    return lower


def scaler(context: Context, node: Node) -> Tensor:
    """``(x - offset) * scale`` per feature."""
    x = lift(node.tensor(0)).with_dtype(FLOAT32)
    offset = np.asarray(node.attribute("offset", [0.0]), np.float64)
    scale = np.asarray(node.attribute("scale", [1.0]), np.float64)
    centred = context.algebra.add(x, lift(Constant.of(offset)), -1.0)
    return context.algebra.multiply(centred, lift(Constant.of(scale)))


def linear_regressor(context: Context, node: Node) -> Tensor:
    """``x @ coefficients.T + intercepts``."""
    x = lift(node.tensor(0)).with_dtype(FLOAT32)
    transform = node.attribute("post_transform", "NONE")
    if transform != "NONE":
        raise UnsupportedNode(f"post_transform {transform!r} is not supported", "export the raw regression values")
    targets = int(node.attribute("targets", 1))
    weights = np.asarray(node.attribute("coefficients"), np.float64).reshape(targets, -1)
    intercepts = node.attribute("intercepts")
    bias = np.zeros(targets) if intercepts is None else np.asarray(intercepts, np.float64)
    return lift(matmul(context.algebra, x, Constant.of(weights.T), bias))


def array_feature_extractor(_context: Context, node: Node) -> Constant | Tensor:
    """Columns of the last axis, as a matrix."""
    x = node.tensor(0)
    columns = wrapped(indices_of(node).reshape(-1), x.shape[-1])
    return rearrange(x, lambda array: np.take(np.atleast_2d(array), columns, -1))


def binarizer(context: Context, node: Node) -> Tensor:
    """One above the threshold, else zero."""
    threshold = constant(number(node, "threshold", 0.0))
    return context.algebra.unary(lift(node.tensor(0)), lambda x: formulas.truth_as_number(apply("less", threshold, x)))


def imputer(_context: Context, node: Node) -> Constant | Tensor:
    """Replaces missing values, which points do not have."""
    missing = node.attribute("replaced_value_float", 0.0)
    if not np.isnan(missing):
        raise UnsupportedNode(f"it replaces the value {missing}, which is a jump", "mark missing values by NaN")
    return node.tensor(0)


def feature_vectorizer(_context: Context, node: Node) -> Constant | Tensor:
    """The inputs side by side, as real numbers."""
    parts = [lift(node.tensor(index)).with_dtype(FLOAT32) for index in range(len(node.inputs))]
    parts = [part.reshape(part.shape[0], -1) for part in parts]
    widths = [part.shape[1] for part in parts]
    declared = list(node.attribute("inputdimensions", widths))
    if declared != widths:
        raise UnsupportedNode(f"inputdimensions {declared} are not the widths of its inputs, {widths}")
    return concatenate(parts, 1)


MICROSOFT: Table = {
    "FusedGemm": same(fused_gemm),
    "FusedConv": same(fused_convolution),
    "FusedMatMul": same(fused_matmul),
    "TransposeMatMul": same(fused_matmul),
    "Gelu": elementwise(lambda _n, x: formulas.gelu(x)),
    "BiasGelu": same(biased(formulas.gelu), 1, "surrogate"),
    "FastGelu": same(biased(formulas.gelu_tanh), 1, "surrogate"),
    "QuickGelu": elementwise(lambda n, x: formulas.swish(x, number(n, "alpha", 1.702))),
    "DequantizeLinear": same(dequantize, on_constants=True),
    "MatMulNBits": same(matmul_of_packed_weights),
    "ExpandDims": same(shape.unsqueeze, on_constants=True),
    "Trilu": same(shape.triangle, on_constants=True),
    "Pad": same(shape.pad_by_inputs, on_constants=True),
}

MACHINE_LEARNING: Table = {
    "Scaler": same(scaler),
    "LinearRegressor": same(linear_regressor),
    "ArrayFeatureExtractor": same(array_feature_extractor, on_constants=True),
    "Binarizer": same(binarizer),
    "Imputer": same(imputer),
    "FeatureVectorizer": same(feature_vectorizer),
}
