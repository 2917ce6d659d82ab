"""From an ONNX model to the imported-stage network: a scalar function of one point."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnx
import onnx.inliner
from numpy.typing import ArrayLike

from mn_onnx.binding import bind_inputs, graph_inputs, has_free_width, with_width
from mn_onnx.errors import ModelRefused, Problem, UsageError
from mn_onnx.ir.network import AffineRow, Floats, Integers, Network, Unit
from mn_onnx.layout import BoundInput, Layout, Output, PointInput, point_count
from mn_onnx.lowering import LOWERINGS, REFUSALS
from mn_onnx.lowering.context import Context, GraphValue, Scope
from mn_onnx.reader.structure import opset_versions
from mn_onnx.symbolic import (
    CONSTANT,
    NO_POINT,
    Constant,
    Opaque,
    Tensor,
    check_size,
    is_float,
    lift,
)
from mn_onnx.symbolic.store import Store

FREE_BATCHES = (2, 5)
"""A model of any number of points is run with these numbers; it must compute the same function with both."""
WIDTHS = (3, 2, 1)
"""Numbers of columns that are tried where the model declares none."""
MOST_POINTS = 4096
"""A static batch up to this size is run as it is; a larger one as if its size were free."""


@dataclass(frozen=True, eq=False)
class Imported:
    """A model as a function of one point.

    ``network`` is at the imported stage; its output row is the chosen output itself, no level subtracted. ``layout``
    feeds the model to other runtimes. ``metadata`` are the model's metadata properties.
    """

    network: Network
    layout: Layout
    input_dim: int
    metadata: dict[str, str]


@dataclass(frozen=True, eq=False)
class _Run:
    """One symbolic run: the context after it, and the chosen output."""

    context: Context
    output: Output
    field: Tensor


def import_network(
    model: onnx.ModelProto,
    *,
    output: str | None = None,
    channel: int | None = None,
    bind: Mapping[str, ArrayLike] | None = None,
    coordinates: Sequence[int | str] | None = None,
) -> Imported:
    """Import a model as a scalar function of one point.

    ``model``: self-contained, as `mn_onnx.reader.read_model` gives it. ``output``: the name of the output, needed where
    several give one value per point. ``channel``: its channel, needed where it has several. ``bind``: extra inputs, or
    columns of the points (``"x[3:]"``), to constants. ``coordinates``: which columns or inputs are the coordinates; see
    `mn_onnx.binding.bind_inputs`.

    Raises `ModelRefused` with every problem that reaches the chosen output, `UsageError` for names that do not fit.
    """
    if model.functions:
        model = onnx.inliner.inline_local_functions(model)
    inputs, bound = graph_inputs(model), bind or {}
    if not has_free_width(inputs, bound):
        return _import(model, bind_inputs(inputs, bound, coordinates), output, channel)
    refusals = []
    for width in WIDTHS:
        try:
            return _import(model, bind_inputs(with_width(inputs, width), bound, coordinates), output, channel)
        except ModelRefused as error:
            refusals.append(error)
    raise refusals[0]


def _import(
    model: onnx.ModelProto,
    roles: tuple[tuple[PointInput | BoundInput, ...], int],
    output: str | None,
    channel: int | None,
) -> Imported:
    inputs, dim = roles
    points = [entry for entry in inputs if isinstance(entry, PointInput)]
    batch = point_count(points[0].shape, points[0].axis)
    layout = Layout(inputs, dim, batch, Output("", None, 0))
    if batch is not None and batch <= MOST_POINTS:
        run = _run(model, layout, batch, output, channel)
        network = _network(run, dim)
    else:
        run, network = _run_with_two_batches(model, layout, output, channel)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    return Imported(network, dataclasses.replace(layout, output=run.output), dim, metadata)


def _run_with_two_batches(
    model: onnx.ModelProto, layout: Layout, output: str | None, channel: int | None
) -> tuple[_Run, Network]:
    """Run with two batch sizes. Raises `ModelRefused`, naming the first node that differs, unless both agree."""
    free = layout if layout.batch is None else _with_free_batch(layout)
    try:
        first, second = (_run(model, free, n, output, channel) for n in FREE_BATCHES)
    except ModelRefused as error:
        if layout.batch is None:
            raise
        problem = _problem(
            "",
            f"the model takes {layout.batch} points at once, too many to be analysed, and not any other number",
            "export with a dynamic number of points",
        )
        raise ModelRefused([problem, *error.problems]) from error
    network = _network(first, layout.dim)
    if first.output != second.output or not _same(network, _network(second, layout.dim)):
        raise ModelRefused([_batch_problem(first.context, second.context)])
    return first, network


def _with_free_batch(layout: Layout) -> Layout:
    entries = [
        dataclasses.replace(entry, shape=tuple(None if size == layout.batch else size for size in entry.shape))
        for entry in layout.inputs
    ]
    return dataclasses.replace(layout, inputs=tuple(entries), batch=None)


def _run(model: onnx.ModelProto, layout: Layout, n: int, output: str | None, channel: int | None) -> _Run:
    context = Context(Store(layout.dim), opset_versions(model), LOWERINGS, REFUSALS)
    scope: Scope = {entry.name: _input_value(entry, n) for entry in layout.inputs}
    names = [value.name for value in model.graph.output]
    values = dict(zip(names, context.run_graph(model.graph, scope), strict=True))
    chosen = _choose_output(context, values, n, output)
    field, place = _choose_channel(context, chosen, values[chosen], n, channel)
    field = context.algebra.settle(field)
    if problems := context.problems_of(field):
        raise ModelRefused([context.problems[number] for number in sorted(problems)])
    functions = (field.base, field.function, field.scale, field.offset)
    if not all((part == part[0]).all() for part in functions):
        raise ModelRefused([_place_problem(context, chosen)])
    return _Run(context, place, field)


def _input_value(entry: PointInput | BoundInput, n: int) -> Constant | Tensor:
    if isinstance(entry, BoundInput):
        shape = tuple(n if size is None else size for size in entry.shape)
        check_size(shape)
        return Constant.of(np.array(np.broadcast_to(entry.value, shape)), entry.dtype)
    width = len(entry.columns)
    coordinate = np.broadcast_to(np.array(entry.columns), (n, width))
    live = coordinate >= 0
    tensor = Tensor(
        np.where(live, np.arange(n, dtype=np.int32)[:, None], np.int32(NO_POINT)),
        np.where(live, coordinate, CONSTANT),
        np.zeros((n, width), np.int32),
        live.astype(np.float64),
        np.where(live, 0.0, entry.values),
        entry.dtype,
    )
    return tensor.map(entry.arrange)


def _problem(name: str, reason: str, remedy: str) -> Problem:
    return Problem(f"output {name!r}" if name else "", "", 0, reason, remedy)


def _choose_output(context: Context, values: Mapping[str, GraphValue], n: int, output: str | None) -> str:
    """The output by name, or the only one that gives one real number per point."""
    if output is not None:
        if output not in values:
            raise UsageError(f"there is no output {output!r}; the outputs are: {', '.join(map(repr, values))}")
        return output
    if len(values) == 1:
        return next(iter(values))
    usable = {
        name: value
        for name, value in values.items()
        if isinstance(value, (Constant, Tensor)) and is_float(value.dtype) and not context.problems_of(value)
    }
    single = [name for name, value in usable.items() if math.prod(value.shape) == n and isinstance(value, Tensor)]
    if len(single) == 1:
        return single[0]
    candidates = single or list(usable)
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        problems = sorted(frozenset().union(*(context.problems_of(value) for value in values.values())))
        if problems:
            raise ModelRefused([context.problems[number] for number in problems])
    shown = ", ".join(repr(name) for name in candidates or values)
    raise ModelRefused(
        [
            _problem(
                "",
                f"several outputs could be the field: {shown}",
                f"choose one: --output {(candidates or list(values))[0]}",
            )
        ]
    )


def _choose_channel(
    context: Context, name: str, value: GraphValue, n: int, channel: int | None
) -> tuple[Tensor, Output]:
    """The field [n] of an output, and where it is."""
    if isinstance(value, Opaque):
        raise ModelRefused([context.problems[number] for number in sorted(value.problems)])
    if not isinstance(value, (Constant, Tensor)):
        raise ModelRefused([_problem(name, "it is a sequence of tensors", "export the field as a tensor")])
    tensor = lift(value)
    if tensor.dtype.kind in "biu":
        raise ModelRefused(
            [_problem(name, f"it has type {tensor.dtype.name}", "choose the output with the real-valued field")]
        )
    axis = _point_axis(tensor, n)
    if axis is None and (n > 1 or tensor.size == 0):
        if problems := context.problems_of(tensor):
            raise ModelRefused([context.problems[number] for number in sorted(problems)])
        raise ModelRefused([_shape_problem(name, tensor, n)])
    rows = tensor.reshape(1, -1) if axis is None else tensor.map(lambda f: np.moveaxis(f, axis, 0))
    rows = rows.reshape(n, tensor.size // n)
    width = rows.shape[1]
    if channel is None and width > 1:
        if problems := context.problems_of(tensor):
            raise ModelRefused([context.problems[number] for number in sorted(problems)])
        raise ModelRefused(
            [_problem(name, f"it has {width} channels", f"choose one, from 0 to {width - 1}: --output {name}:0")]
        )
    chosen = channel or 0
    if not -width <= chosen < width:
        raise UsageError(f"output {name!r} has {width} channels; there is no channel {channel}")
    return rows[:, chosen], Output(name, axis, chosen % width)


def _point_axis(tensor: Tensor, n: int) -> int | None:
    """The axis along which the points lie in order."""
    for axis, size in enumerate(tensor.shape):
        if size == n:
            rows = np.moveaxis(tensor.point, axis, 0).reshape(n, -1)
            live = np.moveaxis(tensor.live, axis, 0).reshape(n, -1)
            if (~live | (rows == np.arange(n)[:, None])).all():
                return axis
    return None


def _shape_problem(name: str, tensor: Tensor, n: int) -> Problem:
    live = tensor.live
    if live.any() and len(np.unique(tensor.point[live])) < n:
        reason = f"its shape {list(tensor.shape)} for {n} points does not give every point values of its own"
        return _problem(name, reason, "export a network that maps every point on its own")
    return _problem(name, f"its shape {list(tensor.shape)} for {n} points has no axis of the points in order",
                    "export the field with shape [N] or [N, channels]")  # fmt: skip


def _place_problem(context: Context, name: str) -> Problem:
    """The first node whose results differ between two points."""
    label = next((trace.label for trace in context.traces if trace.first != trace.last), name)
    reason = "it computes different functions for different places in the batch"
    return context.node_problem(label, reason, "export a network that treats every point alike")


def _batch_problem(first: Context, second: Context) -> Problem:
    """The first node whose results differ between two batch sizes."""
    reason = "the function of a point changes with the number of points in the batch"
    remedy = "export a network without statistics, pooling or scaling over the batch"
    for a, b in zip(first.traces, second.traces, strict=True):
        if a.first != b.first or not first.store.agrees(second.store, a.size):
            return first.node_problem(a.label, reason, remedy)
    return _problem("", reason, remedy)


def _network(run: _Run, dim: int) -> Network:
    """Units that the chosen output needs, in topological order, with variables renumbered."""
    store = run.context.store
    rows = store.rows(run.field[:1], run.output.name)
    needed = np.zeros(dim + len(store.units), np.bool_)
    needed[rows.columns] = True
    for variable in range(len(needed) - 1, dim - 1, -1):
        if needed[variable]:
            base = store.bases[store.units[variable - dim][0]]
            needed[store.directions[base.direction][0]] = True
    needed[:dim] = True
    number = np.cumsum(needed) - 1

    def row(columns: Integers, weights: Floats, bias: float) -> AffineRow:
        return AffineRow(number[columns], weights, float(bias))

    units = []
    for key in (store.units[variable - dim] for variable in np.flatnonzero(needed)[dim:].tolist()):
        base = store.bases[key[0]]
        columns, weights = store.directions[base.direction]
        units.append(Unit(row(columns, weights * base.scale, base.shift), (store.functions[key[1]],), store.names[key]))
    result = row(rows.columns, rows.matrix[0], rows.constants[0])
    return Network(dim, tuple(units), result, run.output.name)


def _same(a: Network, b: Network) -> bool:
    if len(a.units) != len(b.units):
        return False
    pairs = [(a.output, b.output), *((x.row, y.row) for x, y in zip(a.units, b.units, strict=True))]
    return all(
        np.array_equal(x.columns, y.columns) and np.array_equal(x.weights, y.weights) and x.bias == y.bias
        for x, y in pairs
    ) and all(x.functions == y.functions for x, y in zip(a.units, b.units, strict=True))
