"""Lowering of activations and other functions of one number."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mn_onnx.ir.expression import Expression, apply
from mn_onnx.lowering import formulas
from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.table import Fidelity, Lowering, Table, same
from mn_onnx.symbolic import Constant, Tensor, is_float, lift

Formula = Callable[[Node, Expression], Expression]

FLOAT32_MAX = float(np.finfo(np.float32).max)


def elementwise(formula: Formula, fidelity: Fidelity = "surrogate", since: int = 1) -> Sequence[Lowering]:
    """The entry of an operator that applies ``formula`` to every element."""

    def lower(context: Context, node: Node) -> Tensor:
        return context.algebra.unary(lift(node.tensor(0)), lambda x: formula(node, x))

    return same(lower, since, fidelity)


def simple(operation: str, fidelity: Fidelity = "surrogate", since: int = 1) -> Sequence[Lowering]:
    """The entry of an operator that is an operation of `mn_onnx.ir.expression` itself."""
    return elementwise(lambda _node, x: apply(operation, x), fidelity, since)


def number(node: Node, name: str, default: float) -> float:
    """A float attribute; attributes are stored in float32, and so are their defaults."""
    return float(np.float32(node.attribute(name, default)))


def slopes(context: Context, node: Node) -> Tensor:
    """PRelu, whose slope is broadcast to the input."""
    x, slope = lift(node.tensor(0)), lift(node.tensor(1))
    if (slope.base == -1).all():
        return context.algebra.apply([x, slope], _leaky_with_constant, x.dtype)
    algebra = context.algebra
    negative = algebra.unary(x, formulas.negative_part)
    return algebra.add(algebra.unary(x, formulas.positive_part), algebra.multiply(slope, negative))


def _leaky_with_constant(x: Expression, slope: Expression) -> Expression:
    return formulas.leaky(x, slope.value)


def clip_by_attributes(context: Context, node: Node) -> Tensor:
    """Clip before opset 11."""
    lowest, highest = number(node, "min", -FLOAT32_MAX), number(node, "max", FLOAT32_MAX)
    return _clip(context, lift(node.tensor(0)), lowest, highest)


def clip_by_inputs(context: Context, node: Node) -> Tensor:
    """Clip from opset 11 on: the bounds are optional scalar inputs."""
    x = lift(node.tensor(0))
    bounds = []
    for index, (operation, default) in enumerate((("maximum", -math.inf), ("minimum", math.inf)), 1):
        if not node.has(index):
            bounds.append(default)
        elif isinstance(bound := node.tensor(index), Constant):
            bounds.append(float(bound.array.reshape(-1)[0]))
        else:
            x = context.algebra.extremum(x, bound, operation)
            bounds.append(default)
    return _clip(context, x, bounds[0], bounds[1])


def _clip(context: Context, x: Tensor, lowest: float, highest: float) -> Tensor:
    # Exporters write the largest float32 for "no bound".
    lowest = -math.inf if lowest <= -FLOAT32_MAX else lowest
    highest = math.inf if highest >= FLOAT32_MAX else highest
    if lowest == -math.inf and highest == math.inf:
        return x
    return context.algebra.unary(x, lambda e: formulas.clip(e, lowest, highest))


def gelu(node: Node, x: Expression) -> Expression:
    """Gelu: exact, or by tanh if ``approximate`` says so."""
    approximate = node.attribute("approximate", "none")
    if approximate not in ("none", "tanh"):
        raise UnsupportedNode(f"approximate={approximate!r} is not defined; 'none' and 'tanh' are")
    return formulas.gelu_tanh(x) if approximate == "tanh" else formulas.gelu(x)


def selu(alpha: float, gamma: float) -> Callable[[Context, Node], Tensor]:
    """Selu with default parameters, which became longer in opset 6."""

    def lower(context: Context, node: Node) -> Tensor:
        chosen = number(node, "alpha", alpha), number(node, "gamma", gamma)
        return context.algebra.unary(lift(node.tensor(0)), lambda x: formulas.selu(x, *chosen))

    return lower


def is_never(_context: Context, node: Node) -> Constant:
    """IsNaN and IsInf: values at finite points are finite, as infinite weights are refused where they are used."""
    return Constant(np.zeros(node.tensor(0).shape, np.bool_), np.dtype(bool))


def absolute(context: Context, node: Node) -> Tensor:
    """Abs."""
    return context.algebra.unary(lift(node.tensor(0)), lambda x: apply("abs", x))


def rounding(operation: str) -> Sequence[Lowering]:
    """The entry of Floor, Ceil or Round, which leave integers as they are."""

    def lower(context: Context, node: Node) -> Constant | Tensor:
        x = node.tensor(0)
        if not is_float(x.dtype):
            return x
        return context.algebra.unary(lift(x), lambda e: apply(operation, e))

    return same(lower)


LOWERINGS: Table = {
    "Relu": elementwise(lambda _n, x: formulas.positive_part(x), "exact"),
    "LeakyRelu": elementwise(lambda n, x: formulas.leaky(x, number(n, "alpha", 0.01)), "exact"),
    "PRelu": same(slopes, 7),
    "Abs": same(absolute),
    "Clip": [Lowering(6, clip_by_attributes), Lowering(11, clip_by_inputs)],
    "HardSigmoid": elementwise(
        lambda n, x: formulas.hard_sigmoid(x, number(n, "alpha", 0.2), number(n, "beta", 0.5)), "exact"
    ),
    "ThresholdedRelu": elementwise(
        lambda n, x: formulas.thresholded_relu(x, number(n, "alpha", 1.0)), "exact", since=10
    ),
    "Shrink": elementwise(
        lambda n, x: formulas.shrink(x, number(n, "lambd", 0.5), number(n, "bias", 0.0)), "exact", since=9
    ),
    "Sign": simple("sign", "exact", since=9),
    "Floor": rounding("floor"),
    "Ceil": rounding("ceil"),
    "Round": rounding("round"),
    "IsNaN": same(is_never, 9),
    "IsInf": same(is_never, 10),
    "Elu": elementwise(lambda n, x: formulas.elu(x, number(n, "alpha", 1.0))),
    "Selu": [
        Lowering(1, selu(1.6732, 1.0507), "surrogate"),
        Lowering(6, selu(1.67326319217681884765625, 1.05070102214813232421875), "surrogate"),
    ],
    "Celu": elementwise(lambda n, x: formulas.celu(x, number(n, "alpha", 1.0)), since=12),
    "Gelu": elementwise(gelu, since=20),
    "HardSwish": elementwise(lambda _n, x: formulas.hard_swish(x), since=14),
    "Mish": elementwise(lambda _n, x: formulas.mish(x), since=18),
    "Swish": elementwise(lambda n, x: formulas.swish(x, number(n, "alpha", 1.0)), since=24),
    "Softplus": simple("softplus"),
    "Softsign": elementwise(lambda _n, x: formulas.softsign(x)),
    "Sigmoid": simple("sigmoid"),
    "Tanh": simple("tanh"),
    "Erf": simple("erf", since=9),
    "Exp": simple("exp"),
    "Log": simple("log"),
    "Sqrt": simple("sqrt"),
    "Reciprocal": simple("reciprocal"),
    "Sin": simple("sin", since=7),
    "Cos": simple("cos", since=7),
    "Tan": simple("tan", since=7),
    "Asin": simple("asin", since=7),
    "Acos": simple("acos", since=7),
    "Atan": simple("atan", since=7),
    "Sinh": simple("sinh", since=9),
    "Cosh": simple("cosh", since=9),
    "Asinh": simple("asinh", since=9),
    "Acosh": simple("acosh", since=9),
    "Atanh": simple("atanh", since=9),
}
