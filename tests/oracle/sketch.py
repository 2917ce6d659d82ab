"""Write a tiny network once, get it as canonical units, as an ONNX model and as plain values.

A network is a function of a `Sketch`: it combines feature vectors through the sketch's operations and returns the one
output feature. `as_network`, `as_onnx` and `evaluate` run it with their own implementations. Weights
should be dyadic with few bits, so that the float32 model and the float64 units are the same function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np
import onnx
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

RELU = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.0]])
ABS = KnotTable.exact([0.0], [[-1.0, 1.0]], [[0.0, 0.0]])


def leaky_table(slope: float) -> KnotTable:
    return KnotTable.exact([0.0], [[slope, 1.0]], [[0.0, 0.0]])


def clip_table(low: float, high: float) -> KnotTable:
    return KnotTable.exact([low, high], [[0.0, 1.0, 0.0]], [[low, 0.0, high]])


V = TypeVar("V")


class Sketch(Protocol[V]):
    """Operations on feature vectors of type ``V``."""

    def affine(self, x: V, weights: ArrayLike, bias: ArrayLike) -> V:
        """``weights @ x + bias`` with weights [out, in] and bias [out]."""

    def relu(self, x: V) -> V: ...

    def leaky_relu(self, x: V, slope: float) -> V: ...

    def abs(self, x: V) -> V: ...

    def clip(self, x: V, low: float, high: float) -> V: ...

    def maximum(self, x: V, y: V) -> V:
        """Elementwise, as ``y + relu(x - y)``."""

    def minimum(self, x: V, y: V) -> V:
        """Elementwise, as ``x - relu(x - y)``."""

    def concat(self, x: V, y: V) -> V: ...


Body = Callable[[Sketch[Any], Any], Any]
Values = NDArray[np.float64]


class _Rows:
    """Affine functions of the variables: ``weights`` [n, variables so far] and ``bias`` [n]."""

    def __init__(self, weights: Values, bias: Values) -> None:
        self.weights = weights
        self.bias = bias

    def widened(self, n_variables: int) -> Values:
        missing = n_variables - self.weights.shape[1]
        return np.pad(self.weights, ((0, 0), (0, missing)))


class _UnitSketch:
    """Implements `Sketch` by canonical units; constant features become rows, not units."""

    def __init__(self, dimension: int) -> None:
        self.n_variables = dimension
        self.units: list[Unit] = []

    def affine(self, x: _Rows, weights: ArrayLike, bias: ArrayLike) -> _Rows:
        matrix = np.atleast_2d(np.asarray(weights, np.float64))
        return _Rows(matrix @ x.weights, matrix @ x.bias + np.asarray(bias, np.float64))

    def relu(self, x: _Rows) -> _Rows:
        return self._apply(x, RELU, "relu")

    def leaky_relu(self, x: _Rows, slope: float) -> _Rows:
        return self._apply(x, leaky_table(slope), "leaky_relu")

    def abs(self, x: _Rows) -> _Rows:
        return self._apply(x, ABS, "abs")

    def clip(self, x: _Rows, low: float, high: float) -> _Rows:
        return self._apply(x, clip_table(low, high), "clip")

    def maximum(self, x: _Rows, y: _Rows) -> _Rows:
        return self._sum(y, self.relu(self._sum(x, y, -1.0)))

    def minimum(self, x: _Rows, y: _Rows) -> _Rows:
        return self._sum(x, self.relu(self._sum(x, y, -1.0)), -1.0)

    def concat(self, x: _Rows, y: _Rows) -> _Rows:
        weights = np.concatenate([x.widened(self.n_variables), y.widened(self.n_variables)])
        return _Rows(weights, np.concatenate([x.bias, y.bias]))

    def _sum(self, x: _Rows, y: _Rows, factor: float = 1.0) -> _Rows:
        return _Rows(
            x.widened(self.n_variables) + factor * y.widened(self.n_variables),
            x.bias + factor * y.bias,
        )

    def _apply(self, x: _Rows, table: KnotTable, name: str) -> _Rows:
        for weights, bias in zip(x.weights, x.bias, strict=True):
            self.units.append(Unit(affine_row(weights, float(bias)), (table,), f"{name}_{len(self.units)}", table))
        self.n_variables += len(x.bias)
        outputs = np.eye(self.n_variables)[self.n_variables - len(x.bias) :]
        return _Rows(outputs, np.zeros(len(x.bias)))


def affine_row(weights: ArrayLike, bias: float) -> AffineRow:
    """The row of a dense weight vector, without its zeros."""
    dense = np.asarray(weights, np.float64)
    columns = np.flatnonzero(dense)
    return AffineRow(columns, dense[columns], bias)


def as_network(body: Body, dimension: int = 3) -> Network:
    """The canonical network of ``body`` over ``dimension`` coordinates; proportional rows are not merged."""
    sketch = _UnitSketch(dimension)
    rows = body(sketch, _Rows(np.eye(dimension), np.zeros(dimension)))
    (weights,) = rows.weights
    return Network(dimension, tuple(sketch.units), affine_row(weights, float(rows.bias[0])))


class _ValueSketch:
    """Implements `Sketch` by numpy on points; a feature vector is an array [features, points]."""

    def affine(self, x: Values, weights: ArrayLike, bias: ArrayLike) -> Values:
        matrix = np.atleast_2d(np.asarray(weights, np.float64))
        return matrix @ x + np.broadcast_to(np.asarray(bias, np.float64), matrix.shape[:1])[:, None]

    def relu(self, x: Values) -> Values:
        return np.maximum(x, 0.0)

    def leaky_relu(self, x: Values, slope: float) -> Values:
        return np.where(x < 0, slope * x, x)

    def abs(self, x: Values) -> Values:
        return np.abs(x)

    def clip(self, x: Values, low: float, high: float) -> Values:
        return np.clip(x, low, high)

    def maximum(self, x: Values, y: Values) -> Values:
        return np.maximum(x, y)

    def minimum(self, x: Values, y: Values) -> Values:
        return np.minimum(x, y)

    def concat(self, x: Values, y: Values) -> Values:
        return np.concatenate([x, y])


def evaluate(body: Body, points: ArrayLike) -> Values:
    """The values [n] of ``body`` at ``points`` [n, dimension], without units and tables."""
    (values,) = body(_ValueSketch(), np.asarray(points, np.float64).T)
    return values


class _OnnxSketch:
    """Implements `Sketch` by ONNX nodes; a feature vector is the name of a [N, features] tensor."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []

    def affine(self, x: str, weights: ArrayLike, bias: ArrayLike) -> str:
        matrix = np.atleast_2d(np.asarray(weights, np.float32))
        inputs = [x, self._constant(matrix), self._constant(np.broadcast_to(np.float32(bias), matrix.shape[:1]))]
        return self._node("Gemm", inputs, transB=1)

    def relu(self, x: str) -> str:
        return self._node("Relu", [x])

    def leaky_relu(self, x: str, slope: float) -> str:
        return self._node("LeakyRelu", [x], alpha=slope)

    def abs(self, x: str) -> str:
        return self._node("Abs", [x])

    def clip(self, x: str, low: float, high: float) -> str:
        return self._node("Clip", [x, self._constant(np.float32(low)), self._constant(np.float32(high))])

    def maximum(self, x: str, y: str) -> str:
        return self._node("Max", [x, y])

    def minimum(self, x: str, y: str) -> str:
        return self._node("Min", [x, y])

    def concat(self, x: str, y: str) -> str:
        return self._node("Concat", [x, y], axis=1)

    def _constant(self, value: ArrayLike) -> str:
        name = f"constant_{len(self.initializers)}"
        self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(value, np.float32), name))
        return name

    def _node(self, op: str, inputs: list[str], **attributes: float) -> str:
        name = f"/{op.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, inputs, [f"{name}.out"], name=name, **attributes))
        return f"{name}.out"


def as_onnx(body: Body, dimension: int = 3) -> onnx.ModelProto:
    """The ONNX model of ``body``: input ``x`` [N, dimension], output ``f`` [N, 1], float32, opset 17."""
    sketch = _OnnxSketch()
    output = body(sketch, "x")
    sketch.nodes.append(helper.make_node("Identity", [output], ["f"], name="/output"))
    graph = helper.make_graph(
        sketch.nodes,
        "sketch",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", dimension])],
        [helper.make_tensor_value_info("f", TensorProto.FLOAT, ["N", 1])],
        sketch.initializers,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return model
