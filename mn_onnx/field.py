"""Which output of a model is the field, and where in it the value of a point is."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mn_onnx.errors import ModelRefused, Problem, UsageError
from mn_onnx.layout import Output
from mn_onnx.lowering.context import Context, GraphValue
from mn_onnx.symbolic import NO_POINT, Constant, Opaque, Tensor, is_float, lift


def output_problem(name: str, reason: str, remedy: str) -> Problem:
    """A problem of the output ``name``, or of all if it is empty."""
    return Problem(f"output {name!r}" if name else "", "", 0, reason, remedy)


def choose_output(context: Context, values: Mapping[str, GraphValue], n: int, output: str | None) -> str:
    """The output by name, or the only one that gives one real number for each of ``n`` points.

    Raises `UsageError` for an unknown name, `ModelRefused` if several could be meant.
    """
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
            output_problem(
                "",
                f"several outputs could be the field: {shown}",
                f"choose one: --output {(candidates or list(values))[0]}",
            )
        ]
    )


def choose_channel(
    context: Context, name: str, value: GraphValue, n: int, channel: int | None
) -> tuple[Tensor, Output]:
    """The field [n] of the output ``name``, and where it is.

    Raises `UsageError` for a channel that is not there, `ModelRefused` if the output is no field or one of several.
    """
    if isinstance(value, Opaque):
        raise ModelRefused([context.problems[number] for number in sorted(value.problems)])
    if not isinstance(value, (Constant, Tensor)):
        raise ModelRefused([output_problem(name, "it is a sequence of tensors", "export the field as a tensor")])
    tensor = lift(value)
    if tensor.dtype.kind in "biu":
        raise ModelRefused(
            [output_problem(name, f"it has type {tensor.dtype.name}", "choose the output with the real-valued field")]
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
            [output_problem(name, f"it has {width} channels", f"choose one, from 0 to {width - 1}: --output {name}:0")]
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
            if (~live | (rows == NO_POINT) | (rows == np.arange(n)[:, None])).all():
                return axis
    return None


def _shape_problem(name: str, tensor: Tensor, n: int) -> Problem:
    live = tensor.live
    if live.any() and len(np.unique(tensor.point[live])) < n:
        reason = f"its shape {list(tensor.shape)} for {n} points does not give every point values of its own"
        return output_problem(name, reason, "export a network that maps every point on its own")
    return output_problem(name, f"its shape {list(tensor.shape)} for {n} points has no axis of the points in order",
                    "export the field with shape [N] or [N, channels]")  # fmt: skip
