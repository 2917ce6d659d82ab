"""Lowering of reductions, pools, sorting, and the heads that compare channels."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mn_onnx.ir.expression import apply, constant
from mn_onnx.lowering.arithmetic import balanced
from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.table import Lowering, Table, same
from mn_onnx.lowering.windows import Windows, gather_windows
from mn_onnx.symbolic import Constant, Opaque, Tensor, join, lift
from mn_onnx.symbolic.linear import contract

Reducer = Callable[[Context, Tensor], Tensor]
"""Reduces [rows, k] to [rows]."""

SORT_LIMIT = 4096
"""Most comparisons of one sort."""


def reduce(reducer: Reducer, axes_input_since: int) -> Callable[[Context, Node], Tensor]:
    """A reduction over the axes given in an attribute or, from ``axes_input_since`` on, in an input."""

    def lower(context: Context, node: Node) -> Tensor:
        x = lift(node.tensor(0))
        rank = len(x.shape)
        axes = node.integers(1, "axes", "list of axes") if node.version >= axes_input_since else node.attribute("axes")
        if axes:
            chosen = sorted({normal_axis(axis, rank) for axis in axes})
        else:  # of no axes, what is done to every element before and after summing is still done
            chosen = [] if node.attribute("noop_with_empty_axes", 0) else list(range(rank))
        kept = [axis for axis in range(rank) if axis not in chosen]
        moved = x.map(lambda field: np.transpose(field, kept + chosen))
        count = math.prod(x.shape[axis] for axis in chosen)
        if count == 0:
            raise UnsupportedNode(f"it reduces an empty axis of {list(x.shape)}")
        rows = moved.reshape(math.prod(x.shape[axis] for axis in kept), count)
        result = reducer(context, rows)
        keep = node.attribute("keepdims", 1)
        shape = [1 if axis in chosen else size for axis, size in enumerate(x.shape) if keep or axis not in chosen]
        return result.reshape(*shape)

    return lower


def normal_axis(axis: int, rank: int) -> int:
    """A non-negative axis; raises `UnsupportedNode` if there is no such axis."""
    if not -rank <= axis < max(rank, 1):
        raise UnsupportedNode(f"axis {axis} does not exist in a tensor of {rank} axes")
    return int(axis) % max(rank, 1)


def total(context: Context, rows: Tensor) -> Tensor:
    """The sum."""
    return contract(context.algebra, rows, np.ones((rows.shape[1], 1))).reshape(-1)


def average(context: Context, rows: Tensor) -> Tensor:
    """The mean."""
    return contract(context.algebra, rows, np.full((rows.shape[1], 1), 1.0 / rows.shape[1])).reshape(-1)


def total_absolute(context: Context, rows: Tensor) -> Tensor:
    """The sum of absolute values."""
    return total(context, context.algebra.unary(rows, lambda x: apply("abs", x)))


def total_square(context: Context, rows: Tensor) -> Tensor:
    """The sum of squares."""
    return total(context, context.algebra.unary(rows, lambda x: apply("power", x, constant(2.0))))


def euclidean(context: Context, rows: Tensor) -> Tensor:
    """The root of the sum of squares; of one number, its absolute value."""
    if rows.shape[1] == 1:
        return total_absolute(context, rows)
    # Squares are not negative, but the surrogates of squares may be.
    zero = constant(0.0)
    return context.algebra.unary(total_square(context, rows), lambda x: apply("sqrt", apply("maximum", x, zero)))


def log_total(context: Context, rows: Tensor) -> Tensor:
    """The logarithm of the sum."""
    return context.algebra.unary(total(context, rows), lambda x: apply("log", x))


def extreme(operation: str) -> Reducer:
    """The reducer for the maximum or minimum, as a balanced tree."""
    return lambda context, rows: tree(rows, lambda x, y: context.algebra.extremum(x, y, operation))


def total_product(context: Context, rows: Tensor) -> Tensor:
    """The product."""
    return tree(rows, context.algebra.multiply)


def log_total_exp(context: Context, rows: Tensor) -> Tensor:
    """``log(e^a + e^b) = b + softplus(a - b)``."""
    algebra = context.algebra

    def join(x: Tensor, y: Tensor) -> Tensor:
        return algebra.add(y, algebra.unary(algebra.add(x, y, -1.0), lambda d: apply("softplus", d)))

    return tree(rows, join)


def tree(rows: Tensor, join: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Join the columns of [rows, k] pairwise."""
    return balanced([rows[:, i] for i in range(rows.shape[1])], join)


def pool(reducer: Reducer, padding: float) -> Callable[[Context, Node], Tensor]:
    """A pool over windows of the spatial axes."""

    def lower(context: Context, node: Node) -> Tensor:
        x = lift(node.tensor(0))
        if node.n_outputs > 1 and node.wants(1):
            raise UnsupportedNode("the positions of the maxima are not supported")
        windows = Windows.of_node(node, x.shape[2:], tuple(node.attribute("kernel_shape", ())))
        patches = gather_windows(x, windows, padding)
        rows = patches.reshape(-1, patches.shape[-1])
        return reducer(context, rows).reshape(*x.shape[:2], *windows.places)

    return lower


def average_pool(context: Context, node: Node) -> Tensor:
    """The mean over each window, of the elements of the input alone or, if asked, of the padded input."""
    x = lift(node.tensor(0))
    windows = Windows.of_node(node, x.shape[2:], tuple(node.attribute("kernel_shape", ())))
    counted = windows.in_padded if node.attribute("count_include_pad", 0) else windows.index >= 0
    patches = gather_windows(x, windows, 0.0)
    factors = Constant.of(1.0 / counted.sum(axis=1, keepdims=True))
    rows = context.algebra.multiply(patches, lift(factors)).reshape(-1, patches.shape[-1])
    return total(context, rows).reshape(*x.shape[:2], *windows.places)


def global_pool(reducer: Reducer) -> Callable[[Context, Node], Tensor]:
    """The lowering of a pool over all spatial axes."""

    def lower(context: Context, node: Node) -> Tensor:
        x = lift(node.tensor(0))
        spatial = x.shape[2:]
        result = reducer(context, x.reshape(x.shape[0] * x.shape[1], math.prod(spatial)))
        return result.reshape(*x.shape[:2], *([1] * len(spatial)))

    return lower


def softmax(log: bool, flatten: bool) -> Callable[[Context, Node], Tensor]:
    """Softmax of two channels, the sigmoid of their difference, or its logarithm.

    Before opset 13 (``flatten``) it runs over all axes from ``axis`` on, which is 1 by default.
    """

    def lower(context: Context, node: Node) -> Tensor:
        x = lift(node.tensor(0))
        axis = normal_axis(int(node.attribute("axis", 1 if flatten else -1)), len(x.shape))
        if flatten:
            rows = x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))
        else:
            rows = x.map(lambda field: np.moveaxis(field, axis, -1))
        width = rows.shape[-1]
        if width > 2:
            raise UnsupportedNode(
                f"it couples {width} channels; only one or two are supported",
                "export the logits in front of it, and choose a channel",
            )
        if width == 2:
            difference = context.algebra.add(rows, rows[..., ::-1], -1.0)
            if log:
                result = context.algebra.unary(
                    difference, lambda d: apply("negate", apply("softplus", apply("negate", d)))
                )
            else:
                result = context.algebra.unary(difference, lambda d: apply("sigmoid", d))
        else:
            result = lift(Constant.of(np.full(rows.shape, 0.0 if log else 1.0)))
        return result.reshape(*x.shape) if flatten else result.map(lambda field: np.moveaxis(field, -1, axis))

    return lower


def top_k(context: Context, node: Node) -> tuple[Tensor | Opaque, ...]:
    """The largest or smallest elements by a sorting network; their positions stay unknown."""
    x = lift(node.tensor(0))
    axis = normal_axis(int(node.attribute("axis", -1)), len(x.shape))
    if not node.attribute("sorted", 1):
        raise UnsupportedNode("it gives the elements in no defined order (sorted=0)", "export with sorted=True")
    k = int(np.ravel(node.constant(1, "count"))[0]) if node.has(1) else int(node.attribute("k", 1))
    width = x.shape[axis]
    if not 0 <= k <= width:
        raise UnsupportedNode(f"it asks for {k} of {width} elements")
    if width * k > SORT_LIMIT:
        raise UnsupportedNode(f"it sorts {width} elements, which takes too many comparisons")
    columns = list(np.moveaxis(np.arange(x.size).reshape(x.shape), axis, 0))
    elements = [x.take(column) for column in columns]
    largest = bool(node.attribute("largest", 1))
    low, high = ("maximum", "minimum") if largest else ("minimum", "maximum")
    # Selection: after round i the first i + 1 elements are in place.
    for i in range(k):
        for j in range(width - 1, i, -1):
            a, b = elements[j - 1], elements[j]
            elements[j - 1] = context.algebra.extremum(a, b, low)
            elements[j] = context.algebra.extremum(a, b, high)
    values = join(elements[:k], lambda fields: np.stack(fields, axis))
    if not node.wants(1):
        return (values,)
    return values, context.unknown("the positions of sorted elements jump from point to point")


def cumulative_sum(context: Context, node: Node) -> Tensor:
    """CumSum along an axis."""
    x = lift(node.tensor(0))
    axis = normal_axis(int(np.ravel(node.constant(1, "axis"))[0]), len(x.shape))
    size = x.shape[axis]
    weights = np.triu(np.ones((size, size)), 1 if node.attribute("exclusive", 0) else 0)
    if node.attribute("reverse", 0):
        weights = weights.T
    rows = x.map(lambda field: np.moveaxis(field, axis, -1))
    sums = contract(context.algebra, rows.reshape(-1, size), weights).reshape(*rows.shape)
    return sums.map(lambda field: np.moveaxis(field, -1, axis))


LOWERINGS: Table = {
    "ReduceSum": same(reduce(total, 13)),
    "ReduceMean": same(reduce(average, 18)),
    "ReduceMax": same(reduce(extreme("maximum"), 18)),
    "ReduceMin": same(reduce(extreme("minimum"), 18)),
    "ReduceL1": same(reduce(total_absolute, 18)),
    "ReduceL2": same(reduce(euclidean, 18), 1, "surrogate"),
    "ReduceSumSquare": same(reduce(total_square, 18), 1, "surrogate"),
    "ReduceProd": same(reduce(total_product, 18), 1, "surrogate"),
    "ReduceLogSum": same(reduce(log_total, 18), 1, "surrogate"),
    "ReduceLogSumExp": same(reduce(log_total_exp, 18), 1, "surrogate"),
    "MaxPool": same(pool(extreme("maximum"), -np.inf)),
    "AveragePool": same(average_pool),
    "GlobalMaxPool": same(global_pool(extreme("maximum"))),
    "GlobalAveragePool": same(global_pool(average)),
    "Softmax": [Lowering(1, softmax(False, True), "surrogate"), Lowering(13, softmax(False, False), "surrogate")],
    "LogSoftmax": [Lowering(1, softmax(True, True), "surrogate"), Lowering(13, softmax(True, False), "surrogate")],
    "TopK": same(top_k),
    "CumSum": same(cumulative_sum, 11),
}
