"""From an ONNX model to the imported-stage network: a scalar function of one point."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
import onnx
from numpy.typing import ArrayLike

from mn_onnx.binding import GraphInput, bind_inputs, graph_inputs, has_free_width, input_of_key, with_width
from mn_onnx.errors import ModelRefused, Problem
from mn_onnx.field import choose_channel, choose_output, output_problem
from mn_onnx.ir.network import AffineRow, Floats, Integers, Network, Unit
from mn_onnx.ir.substitute import with_fixed_inputs
from mn_onnx.layout import BoundInput, Layout, Output, PointInput, parameter_values, point_count
from mn_onnx.lowering import LOWERINGS, REFUSALS
from mn_onnx.lowering.context import Context, Scope
from mn_onnx.reader.functions import inline_functions
from mn_onnx.reader.structure import opset_versions
from mn_onnx.symbolic import (
    NO_POINT,
    Constant,
    Tensor,
    check_size,
)
from mn_onnx.symbolic.store import Store

FREE_BATCHES = (2, 5)
"""A model of any number of points is run with these numbers; it must compute the same function with both."""
WIDTHS = (3, 2, 1)
"""Numbers of columns that are tried where the model declares none."""
MOST_POINTS = 4096
"""A static batch up to this size is run as it is; a larger one as if its size were free."""


class ImportOptions(TypedDict, total=False):
    """What to import of a model.

    ``output``: the name of the output, needed where several give one value per point. ``channel``: its channel, needed
    where it has several. ``bind``: extra inputs, or columns of the points (``"x[3:]"``), to constants. ``coordinates``:
    which columns or inputs are the coordinates; see `mn_onnx.binding.bind_inputs`.
    """

    output: str | None
    channel: int | None
    bind: Mapping[str, ArrayLike] | None
    coordinates: Sequence[int | str] | None


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
class Family:
    """A model as a function of one point and of parameters, imported once: see `import_family`.

    ``network``: over the coordinates of the point, then the parameters. ``inputs``: those of the graph.
    """

    network: Network
    layout: Layout
    metadata: dict[str, str]
    inputs: tuple[GraphInput, ...]
    coordinates: Sequence[int | str] | None
    parameters: frozenset[str]

    def member(self, bind: Mapping[str, ArrayLike]) -> Imported:
        """The model with its parameters at the values in ``bind``, which binds what `import_family` was given.

        Raises `UsageError` for values that do not fit.
        """
        roles, dim = bind_inputs(self.inputs, bind, self.coordinates)
        values = [parameter_values(entry) for entry in roles if entry.name in self.parameters]
        network = with_fixed_inputs(self.network, np.concatenate(values))
        return Imported(network, dataclasses.replace(self.layout, inputs=roles), dim, self.metadata)


@dataclass(frozen=True, eq=False)
class _Request:
    """What to import: the model, how it is fed, which output; ``first_parameter``: by input, of those left open."""

    model: onnx.ModelProto
    layout: Layout
    output: str | None
    channel: int | None
    first_parameter: Mapping[str, int]
    n_inputs: int


@dataclass(frozen=True, eq=False)
class _Run:
    """One symbolic run: the context after it, and the chosen output."""

    context: Context
    output: Output
    field: Tensor


def import_network(model: onnx.ModelProto, **options: Unpack[ImportOptions]) -> Imported:
    """Import a model as a scalar function of one point.

    ``model``: self-contained, as `mn_onnx.reader.read_model` gives it. ``options``: see `ImportOptions`.

    Raises `ModelRefused` with every problem that reaches the chosen output, `UsageError` for names that do not fit.
    """
    found = import_family(model, (), **options)
    return Imported(found.network, found.layout, found.layout.dim, found.metadata)


def import_family(model: onnx.ModelProto, parameters: Collection[str], **options: Unpack[ImportOptions]) -> Family:
    """Import a model once for many values of its ``parameters``, which are keys of ``bind`` in ``options``.

    Their values there only tell shapes.

    Raises as `import_network`; also where a parameter is multiplied with the point, so that the model is piecewise
    linear only once its value is known.
    """
    if model.functions:
        model = inline_functions(model)
    inputs, bound, coordinates = graph_inputs(model), options.get("bind") or {}, options.get("coordinates")
    choices = [with_width(inputs, width) for width in WIDTHS] if has_free_width(inputs, bound) else [inputs]
    refusals = []
    for choice in choices:
        roles, dim = bind_inputs(choice, bound, coordinates)
        open_ = frozenset(input_of_key(key, choice) for key in parameters)
        try:
            network, layout = _import(model, roles, dim, open_, options)
        except ModelRefused as error:
            refusals.append(error)
            continue
        metadata = {entry.key: entry.value for entry in model.metadata_props}
        return Family(network, layout, metadata, tuple(choice), coordinates, open_)
    raise refusals[0]


def _import(
    model: onnx.ModelProto,
    inputs: tuple[PointInput | BoundInput, ...],
    dim: int,
    parameters: frozenset[str],
    options: ImportOptions,
) -> tuple[Network, Layout]:
    points = [entry for entry in inputs if isinstance(entry, PointInput)]
    batch = point_count(points[0].shape, points[0].axis)
    layout = Layout(inputs, dim, batch, Output("", None, 0))
    first_parameter, n_inputs = {}, dim
    for entry in inputs:
        if entry.name in parameters:
            first_parameter[entry.name] = n_inputs
            n_inputs += parameter_values(entry).size
    request = _Request(model, layout, options.get("output"), options.get("channel"), first_parameter, n_inputs)
    if batch is not None and batch <= MOST_POINTS:
        run = _run(request, batch)
        network = _network(run, n_inputs)
    else:
        run, network = _run_with_two_batches(request)
    return network, dataclasses.replace(layout, output=run.output)


def _run_with_two_batches(request: _Request) -> tuple[_Run, Network]:
    """Run with two batch sizes. Raises `ModelRefused`, naming the first node that differs, unless both agree."""
    layout = request.layout
    free = request if layout.batch is None else dataclasses.replace(request, layout=_with_free_batch(layout))
    try:
        first, second = (_run(free, n) for n in FREE_BATCHES)
    except ModelRefused as error:
        if layout.batch is None:
            raise
        problem = output_problem(
            "",
            f"the model takes {layout.batch} points at once, too many to be analysed, and not any other number",
            "export with a dynamic number of points",
        )
        raise ModelRefused([problem, *error.problems]) from error
    network = _network(first, request.n_inputs)
    if first.output != second.output or not _same(network, _network(second, request.n_inputs)):
        raise ModelRefused([_batch_problem(first.context, second.context)])
    return first, network


def _with_free_batch(layout: Layout) -> Layout:
    entries = [
        dataclasses.replace(entry, shape=tuple(None if size == layout.batch else size for size in entry.shape))
        for entry in layout.inputs
    ]
    return dataclasses.replace(layout, inputs=tuple(entries), batch=None)


def _run(request: _Request, n: int) -> _Run:
    context = Context(Store(request.n_inputs), opset_versions(request.model), LOWERINGS, REFUSALS)
    graph = request.model.graph
    scope: Scope = {
        entry.name: _input_value(entry, n, request.first_parameter.get(entry.name)) for entry in request.layout.inputs
    }
    names = [value.name for value in graph.output]
    values = dict(zip(names, context.run_graph(graph, scope), strict=True))
    chosen = choose_output(context, values, n, request.output)
    field, place = choose_channel(context, chosen, values[chosen], n, request.channel)
    field = context.algebra.settle(field)
    if problems := context.problems_of(field):
        raise ModelRefused([context.problems[number] for number in sorted(problems)])
    functions = (field.base, field.function, field.scale, field.offset)
    if not all((part == part[0]).all() for part in functions):
        raise ModelRefused([_place_problem(context, chosen)])
    return _Run(context, place, field)


def _input_value(entry: PointInput | BoundInput, n: int, first_parameter: int | None) -> Constant | Tensor:
    """The input for ``n`` points; its bound elements are numbers, or the inputs from ``first_parameter`` on."""
    if isinstance(entry, BoundInput):
        shape = tuple(n if size is None else size for size in entry.shape)
        check_size(shape)
        if first_parameter is None:
            return Constant.of(np.array(np.broadcast_to(entry.value, shape)), entry.dtype)
        number = first_parameter + np.arange(entry.value.size).reshape(entry.value.shape)
        return _coordinates(np.array(np.broadcast_to(number, shape)), np.full(shape, NO_POINT), entry.dtype)
    columns, live = np.array(entry.columns), np.array(entry.columns) >= 0
    if first_parameter is not None:
        columns[~live] = first_parameter + np.arange(np.count_nonzero(~live))
    shape = (n, len(columns))
    point = np.where(live, np.arange(n)[:, None], NO_POINT)
    tensor = _coordinates(np.array(np.broadcast_to(columns, shape)), point, entry.dtype)
    if first_parameter is None:
        tensor.scale[:, ~live], tensor.offset[:, ~live] = 0.0, entry.values[~live]
    return tensor.map(entry.arrange)


def _coordinates(number: Integers, point: Integers, dtype: np.dtype) -> Tensor:
    """The inputs of the network by number; elements of number `CONSTANT` are numbers."""
    shape = number.shape
    return Tensor(point.astype(np.int32), number, np.zeros(shape, np.int32), np.ones(shape), np.zeros(shape), dtype)


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
    return output_problem("", reason, remedy)


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
