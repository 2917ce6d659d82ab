"""What users write for boxes, outputs and bindings, turned into checked values."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mn_onnx.errors import UsageError

Floats = NDArray[np.float64]

DEFAULT_BOUNDS = (-1.0, 1.0)
"""The box that neural SDFs are trained in unless something else is said."""


def box(bounds: ArrayLike, dimension: int) -> tuple[Floats, Floats]:
    """The lower and upper corner, float64 [dimension] each.

    ``bounds``: ``(low, high)`` for all axes; ``[dimension, 2]``, a pair per axis; or the same numbers in a row.
    Raises `UsageError` for another shape, for numbers that are not finite, or unless low < high on every axis.
    """
    try:
        values = np.asarray(bounds, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"bounds {bounds!r} are not numbers") from error
    if values.shape == (2,):
        values = np.tile(values, (dimension, 1))
    elif values.shape == (2 * dimension,):
        values = values.reshape(dimension, 2)
    if values.shape != (dimension, 2):
        raise UsageError(
            f"bounds of shape {list(values.shape)} do not fit a field over {dimension} coordinates; "
            f"give LOW HIGH, or LOW HIGH for each of the {dimension} axes"
        )
    if not np.isfinite(values).all() or not (values[:, 0] < values[:, 1]).all():
        raise UsageError(f"bounds {values.tolist()} are not finite pairs LOW < HIGH")
    return np.ascontiguousarray(values[:, 0]), np.ascontiguousarray(values[:, 1])


def bounds_from_metadata(metadata: dict[str, str]) -> list[float] | None:
    """The numbers of the metadata entry ``bounds`` (as in ``[-1, 1]``), None without such an entry or numbers in it."""
    numbers = re.findall(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", metadata.get("bounds", ""))
    return [float(number) for number in numbers] or None


def output_and_channel(text: str | None, names: Collection[str]) -> tuple[str | None, int | None]:
    """``NAME`` or ``NAME:CHANNEL`` as (name, channel); ``:CHANNEL`` alone chooses a channel of the only output.

    ``names``: the outputs of the graph. A name may itself end like a channel, as TensorFlow's ``sdf:0`` does: what is a
    name as it stands is taken as one.
    """
    if text is None or text in names:
        return text, None
    name, colon, channel = text.rpartition(":")
    if colon and re.fullmatch(r"-?\d+", channel):
        return name or None, int(channel)
    return text, None


def bindings(texts: Sequence[str]) -> dict[str, Floats]:
    """``NAME=VALUE`` entries as arrays: a number, numbers with commas between, or the path of a .npy file.

    Raises `UsageError` for anything else, and for a name given twice.
    """
    bound: dict[str, Floats] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise UsageError(f"--bind {text}: expected NAME=VALUE or NAME=file.npy")
        if name in bound:
            raise UsageError(f"--bind {text}: the input {name!r} is bound twice")
        bound[name] = _load_array(text, value) if value.endswith(".npy") else _parse_numbers(text, value)
    return bound


def _load_array(text: str, value: str) -> Floats:
    try:
        return np.asarray(np.load(Path(value), allow_pickle=False), np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"--bind {text}: cannot read the array: {error}") from error


def _parse_numbers(text: str, value: str) -> Floats:
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError as error:
        raise UsageError(f"--bind {text}: {value!r} is neither numbers nor a .npy file") from error
    return np.array(numbers[0] if len(numbers) == 1 else numbers, np.float64)


def coordinates(text: str | None) -> list[int | str] | None:
    """``I,J,K`` as a list: numbers of columns, or names of inputs as they stand.

    Raises `UsageError` if one is empty or comes twice.
    """
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(parts) or len(set(parts)) != len(parts):
        raise UsageError(f"--coordinates {text}: expected different columns such as 0,1,2, or names of inputs")
    return [int(part) if re.fullmatch(r"-?\d+", part) else part for part in parts]
