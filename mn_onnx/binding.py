"""Decides which inputs hold the points, which coordinates are in which columns, and what is bound to constants."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import onnx
from numpy.typing import ArrayLike

from mn_onnx.errors import ModelRefused, Problem, UsageError
from mn_onnx.layout import BoundInput, PointInput, point_count
from mn_onnx.symbolic import is_float

_COLUMN_KEY = re.compile(r"(?P<name>.*)\[(?P<columns>[-:,\d\s]*)\]", re.DOTALL)

MAX_DIM = 3


@dataclass(frozen=True, eq=False)
class GraphInput:
    """An input of the graph that no initializer fixes; free axes are None in ``shape``, and named in ``free``."""

    name: str
    dtype: np.dtype
    shape: tuple[int | None, ...]
    free: tuple[str, ...]


@dataclass
class _Columns:
    """Columns of one input that are bound: number to value; and the chosen coordinates, if given."""

    bound: dict[int, float] = field(default_factory=dict)
    chosen: list[int] | None = None


def graph_inputs(model: onnx.ModelProto) -> list[GraphInput]:
    """The inputs that a caller feeds. Raises `ModelRefused` for inputs that are no tensors."""
    fixed = {tensor.name for tensor in model.graph.initializer}
    inputs, problems = [], []
    for value in model.graph.input:
        if value.name in fixed:
            continue
        kind = value.type.tensor_type
        if not value.type.HasField("tensor_type"):
            problems.append(_problem(value.name, "the input is not a tensor", "export it as a tensor"))
            continue
        sizes = [
            axis.dim_value if axis.HasField("dim_value") and axis.dim_value > 0 else None for axis in kind.shape.dim
        ]
        try:
            dtype = np.dtype(onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type))
        except KeyError:
            reason = f"its element type {kind.elem_type} is none that ONNX defines"
            problems.append(_problem(value.name, reason, "export the model again"))
            continue
        free = tuple(axis.dim_param for axis in kind.shape.dim)
        if not kind.HasField("shape"):
            # Without a declared rank, points [N, d] are assumed.
            sizes, free = [None, None], ("", "")
        inputs.append(GraphInput(value.name, dtype, tuple(sizes), free))
    if problems:
        raise ModelRefused(problems)
    if not inputs:
        raise ModelRefused(
            [_problem("", "the graph has no inputs: it is a constant", "export it with the points as input")]
        )
    return inputs


def with_width(inputs: Sequence[GraphInput], width: int) -> list[GraphInput]:
    """The inputs, with ``width`` columns in those that declare no size at all, as of shape [N, d] with d unknown."""
    return [
        dataclasses.replace(entry, shape=(*entry.shape[:-1], width)) if _has_free_width(entry) else entry
        for entry in inputs
    ]


def has_free_width(inputs: Sequence[GraphInput], bind: Mapping[str, ArrayLike]) -> bool:
    """Whether an input that is not bound declares no size at all, so that its number of columns is unknown."""
    return any(_has_free_width(entry) for entry in inputs if entry.name not in bind)


def _has_free_width(entry: GraphInput) -> bool:
    return len(entry.shape) > 1 and not any(entry.shape) and is_float(entry.dtype)


def bind_inputs(
    inputs: Sequence[GraphInput],
    bind: Mapping[str, ArrayLike],
    coordinates: Sequence[int | str] | None,
) -> tuple[tuple[PointInput | BoundInput, ...], int]:
    """The role of every input, and the dimension of the points.

    ``bind``: constants by input name (broadcast to the input's shape), or by columns of the point input: ``x[3]``,
    ``x[0:8]``, ``x[0,2]``, also counted from the end. ``coordinates``: the coordinates in order, as columns of the
    point input, or as names of inputs or ``name[column]``; by default, all columns that are not bound, input after
    input.

    Raises `UsageError` for names, columns or values that do not fit, `ModelRefused` if roles stay open.
    """
    by_name = {entry.name: entry for entry in inputs}
    columns: dict[str, _Columns] = {}
    values: dict[str, np.ndarray] = {}
    for key, value in bind.items():
        name, spec = _parse_key(key, by_name)
        if spec is None:
            values[name] = _numbers(key, value)
        else:
            entry = columns.setdefault(name, _Columns())
            entry.bound.update(_column_values(key, by_name[name], spec, value))
    order = _chosen_coordinates(coordinates, by_name, values, columns)
    points = [entry for entry in inputs if entry.name not in values or entry.name in columns]
    bound = {entry.name: _bound_input(entry, values[entry.name]) for entry in inputs if entry not in points}
    arranged = _arrange(points, columns, values, order)
    roles = tuple(bound[entry.name] if entry.name in bound else arranged[entry.name] for entry in inputs)
    dim = sum(column >= 0 for role in arranged.values() for column in role.columns)
    return roles, dim


def _problem(name: str, reason: str, remedy: str) -> Problem:
    return Problem(f"input {name!r}" if name else "", "", 0, reason, remedy)


def _parse_key(key: str, by_name: Mapping[str, GraphInput]) -> tuple[str, str | None]:
    if key in by_name:
        return key, None
    match = _COLUMN_KEY.fullmatch(key)
    if match is None or match["name"] not in by_name:
        raise UsageError(f"there is no input {key!r}; the inputs are: {', '.join(map(repr, by_name))}")
    return match["name"], match["columns"]


def input_of_key(key: str, inputs: Sequence[GraphInput]) -> str:
    """The input that a key of bound values names, whole or by columns. Raises `UsageError` if there is none."""
    return _parse_key(key, {entry.name: entry for entry in inputs})[0]


def _columns_of(spec: str, width: int, key: str) -> list[int]:
    columns: list[int] = []
    try:
        for part in spec.split(","):
            bounds = [int(n) if n.strip() else None for n in part.split(":")]
            if len(bounds) == 1 and bounds[0] is not None:
                columns.append(range(width)[bounds[0]])
            else:
                columns.extend(range(width)[slice(*bounds)])
    except (IndexError, TypeError, ValueError):
        raise UsageError(f"{key!r} does not name columns of an input with {width} columns") from None
    return columns


def _column_values(key: str, entry: GraphInput, spec: str, value: ArrayLike) -> dict[int, float]:
    axis = coordinate_axis(entry, wide=True)
    if axis is None:
        raise UsageError(f"input {entry.name!r} has no columns to bind: its shape is {_show(entry)}")
    columns = _columns_of(spec, entry.shape[axis] or 0, key)
    given = _numbers(key, value).astype(np.float64).reshape(-1)
    if given.size not in (1, len(columns)):
        raise UsageError(f"{key!r} names {len(columns)} columns, but {given.size} values were given")
    return dict(zip(columns, np.broadcast_to(given, len(columns)).tolist(), strict=True))


def _chosen_coordinates(
    coordinates: Sequence[int | str] | None,
    by_name: Mapping[str, GraphInput],
    values: dict[str, np.ndarray],
    columns: dict[str, _Columns],
) -> list[tuple[str, int]] | None:
    """Input and column of every coordinate, if the user gave them."""
    if coordinates is None:
        return None
    order: list[tuple[str, int]] = []
    for coordinate in coordinates:
        if isinstance(coordinate, str):
            name, spec = _parse_key(coordinate, by_name)
        else:
            name, spec = _only_point_input(by_name, values, coordinates), str(coordinate)
        axis = coordinate_axis(by_name[name], wide=True)
        width = 1 if axis is None else by_name[name].shape[axis] or 0
        order += [(name, column) for column in _columns_of(":" if spec is None else spec, width, str(coordinate))]
    if len(set(order)) < len(order):
        raise UsageError("a column is named twice among the coordinates")
    for name in {name for name, _ in order}:
        entry = columns.setdefault(name, _Columns())
        entry.chosen = [column for other, column in order if other == name]
    return order


def _only_point_input(
    by_name: Mapping[str, GraphInput], values: Mapping[str, np.ndarray], coordinates: Sequence[int | str]
) -> str:
    highest = max(c for c in coordinates if not isinstance(c, str))
    open_ = [name for name in by_name if name not in values] or list(by_name)
    fitting = [
        name for name in open_ if (by_name[name].shape[coordinate_axis(by_name[name], wide=True) or 0] or 0) > highest
    ]
    if len(fitting) != 1:
        raise UsageError("name the input of each coordinate, as in 'points[0]', as several inputs are not bound")
    return fitting[0]


def coordinate_axis(entry: GraphInput, *, wide: bool = False) -> int | None:
    """The axis of the columns: the last one of 2 or 3 columns, else one of 3, 2, more, or 1, looked for in this order.

    ``wide``: columns were named, so that a last axis of more columns comes first. None if there is no such axis, and
    the input holds one number per point.
    """
    sizes = {axis: size for axis, size in enumerate(entry.shape) if size is not None}
    last = sizes.get(len(entry.shape) - 1, 0)
    if last in (2, 3) or (wide and last > MAX_DIM):
        return len(entry.shape) - 1
    fits: tuple[Callable[[int], bool], ...] = (
        lambda size: size == 3,
        lambda size: size == 2,
        lambda size: size > MAX_DIM,
        lambda size: size == 1,
    )
    for fit in fits:
        if axes := [axis for axis, size in sizes.items() if fit(size)]:
            return axes[-1]
    return None


def _numbers(key: str, value: ArrayLike) -> np.ndarray:
    try:
        numbers = np.asarray(value)
    except ValueError:  # rows of several lengths
        numbers = np.asarray(None)
    if numbers.dtype.kind not in "biuf" and not is_float(numbers.dtype):
        raise UsageError(f"{key!r} is bound to something else than numbers: {value!r}")
    if not np.isfinite(numbers.astype(np.float64)).all():
        raise UsageError(f"{key!r} is bound to numbers that are not finite")
    return numbers


def _bound_input(entry: GraphInput, value: np.ndarray) -> BoundInput:
    if is_float(entry.dtype):
        value = value.astype(np.float64)
    else:
        with np.errstate(invalid="ignore"):  # of NaN, and numbers too large for the type: they come back as others
            converted = value.astype(entry.dtype)
        if not np.array_equal(converted, value):
            raise UsageError(f"input {entry.name!r} takes {entry.dtype.name} numbers, but is bound to {value.tolist()}")
        value = converted
    shape = list(entry.shape)
    for back in range(1, min(len(shape), value.ndim) + 1):
        if shape[-back] is None and value.shape[-back] != 1:
            shape[-back] = value.shape[-back]
    known = tuple(1 if size is None else size for size in shape)
    try:
        np.broadcast_to(value, known)
    except ValueError:
        raise UsageError(
            f"input {entry.name!r} takes shape {_show(entry)}, but is bound to values of shape {list(value.shape)}; "
            f"to bind some columns, name them, as in {entry.name}[0:{value.size}]"
        ) from None
    return BoundInput(entry.name, entry.dtype, tuple(shape), value)


def _show(entry: GraphInput) -> str:
    return (
        "["
        + ", ".join(
            name or "?" if size is None else str(size) for size, name in zip(entry.shape, entry.free, strict=True)
        )
        + "]"
    )


def _arrange(
    points: Sequence[GraphInput],
    columns: Mapping[str, _Columns],
    values: Mapping[str, np.ndarray],
    order: list[tuple[str, int]] | None,
) -> dict[str, PointInput]:
    """Point inputs with the coordinate of every column."""
    problems: list[Problem] = []
    if not points:
        raise UsageError("every input is bound: no input is left for the points")
    arranged: dict[str, PointInput] = {}
    next_coordinate = 0
    for entry in points:
        if not is_float(entry.dtype):
            problems.append(_integer_input(entry))
            continue
        special = columns.get(entry.name, _Columns())
        axis = coordinate_axis(entry, wide=entry.name in columns)
        width = 1 if axis is None else entry.shape[axis] or 0
        bound = dict(special.bound)
        if entry.name in values:
            bound |= _remaining_values(entry, width, special, values[entry.name])
        free = [column for column in range(width) if column not in bound]
        if order is not None:
            free = [column for column in free if (entry.name, column) in order]
            if missing := [c for c in range(width) if c not in bound and c not in free]:
                problems.append(_unbound_columns(entry, missing))
                continue
        shape = _shape_per_point(entry, axis)
        if isinstance(shape, Problem):
            problems.append(shape)
            continue
        numbers = {
            column: order.index((entry.name, column)) if order else next_coordinate + i for i, column in enumerate(free)
        }
        next_coordinate += len(free)
        arranged[entry.name] = PointInput(
            entry.name, entry.dtype, shape, axis,
            tuple(numbers.get(column, -1) for column in range(width)),
            np.array([bound.get(column, 0.0) for column in range(width)]),
        )  # fmt: skip
    problems += _role_problems(points, arranged, next_coordinate, order) if not problems else []
    if problems:
        raise ModelRefused(problems)
    return arranged


def _remaining_values(entry: GraphInput, width: int, special: _Columns, value: np.ndarray) -> dict[int, float]:
    open_ = [c for c in range(width) if c not in special.bound and c not in (special.chosen or [])]
    flat = np.asarray(value, np.float64).reshape(-1)
    if flat.size != len(open_):
        raise UsageError(
            f"{flat.size} values for the {len(open_)} columns of input {entry.name!r} that are no coordinates"
        )
    return dict(zip(open_, flat.tolist(), strict=True))


def _shape_per_point(entry: GraphInput, axis: int | None) -> tuple[int | None, ...] | Problem:
    """The shape with one axis for the points: the last free one; further free axes have size 1."""
    others = [i for i in range(len(entry.shape)) if i != axis]
    free = [i for i in others if entry.shape[i] is None]
    long = [i for i in others if (entry.shape[i] or 1) > 1]
    if len(long) > 1 or (long and free):
        return _problem(
            entry.name,
            f"its shape {_show(entry)} is not a batch of points: supported are [N, d], [d], [1, N, d], [1, d, N], "
            "[N, d, 1, 1] with d = 1, 2 or 3 coordinates, and one input [N] or [N, 1] per coordinate",
            "export the network as a function of points, not of images, grids or sequences",
        )
    return tuple(None if free and i == free[-1] else 1 if i in free else size for i, size in enumerate(entry.shape))


def _role_problems(
    points: Sequence[GraphInput], arranged: Mapping[str, PointInput], dim: int, order: list[tuple[str, int]] | None
) -> list[Problem]:
    if order is None and len(points) > 1 and not _splits_coordinates(points, arranged, dim):
        return _unbound_inputs(points, arranged)
    counts = {point_count(role.shape, role.axis) for role in arranged.values()}
    if len(counts) > 1:
        return [_problem("", f"its point inputs hold different numbers of points: {counts}", "bind all but the points")]
    if not 1 <= dim <= MAX_DIM:
        entry = points[0]
        if dim > MAX_DIM and len(points) == 1:
            return [
                _unbound_columns(entry, [c for c, number in enumerate(arranged[entry.name].columns) if number >= 0])
            ]
        return [
            _problem("", f"{dim} coordinates are left; supported are 1 to {MAX_DIM}", "bind the others to constants")
        ]
    return []


def _splits_coordinates(points: Sequence[GraphInput], arranged: Mapping[str, PointInput], dim: int) -> bool:
    """Whether several inputs are plainly the coordinates: one column each, or named by the letters of their columns."""
    if dim > MAX_DIM:
        return False
    if all(len(role.columns) == 1 for role in arranged.values()):
        return not any(entry.name.lower() in ("t", "time") for entry in points)
    letters = "".join(entry.name.lower() for entry in points)
    named = all(len(entry.name) == len(arranged[entry.name].columns) for entry in points)
    return named and letters in ("xy", "xyz", "uv", "uvw")


def _unbound_inputs(points: Sequence[GraphInput], arranged: Mapping[str, PointInput]) -> list[Problem]:
    likely = [entry for entry in points if len(arranged[entry.name].columns) in (2, 3)]
    extra = [entry for entry in points if entry is not likely[0]] if len(likely) == 1 else list(points)
    return [
        _problem(
            entry.name,
            f"input of shape {_show(entry)} is not bound, and several inputs cannot all be the points",
            f"bind it to constants: --bind {entry.name}=VALUE[,VALUE...] (or bind={{{entry.name!r}: ...}})",
        )
        for entry in extra
    ]


def _unbound_columns(entry: GraphInput, columns: list[int]) -> Problem:
    return _problem(
        entry.name,
        f"input of shape {_show(entry)} has {len(columns)} columns that are not bound; points have at most {MAX_DIM} "
        "coordinates, and which columns are x, y, z is not known",
        f"bind the others to constants by column: --bind '{entry.name}[{columns[0]}]=VALUE'",
    )


def _integer_input(entry: GraphInput) -> Problem:
    return _problem(
        entry.name,
        f"input of type {entry.dtype.name} and shape {_show(entry)} is not bound; coordinates are real numbers",
        f"bind it if it is an index or an option: --bind {entry.name}=VALUE; a model of integer coordinates or tokens "
        "has no level set",
    )
