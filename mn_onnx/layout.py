"""How points enter a model and values leave it: coordinate axes and columns, bound inputs, the output channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Feeds = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class PointInput:
    """An input that holds coordinates.

    ``shape``: sizes of its axes, None for the axis that counts the points. ``axis``: the axis of the columns, None if
    the input is one coordinate without such an axis. ``columns``: the coordinate in each column, -1 for a bound one,
    whose number is in ``values`` (float64, one per column).
    """

    name: str
    dtype: np.dtype
    shape: tuple[int | None, ...]
    axis: int | None
    columns: tuple[int, ...]
    values: Floats

    def arrange(self, columns: NDArray[np.generic]) -> NDArray[np.generic]:
        """Bring [n, columns] into the input's shape."""
        n = len(columns)
        shape = [n if size is None else size for size in self.shape]
        if self.axis is None:
            return columns.reshape(shape)
        width = shape.pop(self.axis)
        return np.moveaxis(columns.reshape(*shape, width), -1, self.axis)


@dataclass(frozen=True, eq=False)
class BoundInput:
    """An input bound to constants: ``value``, broadcast to ``shape`` (None where it is as long as the batch)."""

    name: str
    dtype: np.dtype
    shape: tuple[int | None, ...]
    value: np.ndarray

    def array(self, n: int) -> np.ndarray:
        """The value for ``n`` points."""
        shape = tuple(n if size is None else size for size in self.shape)
        return np.array(np.broadcast_to(self.value, shape), self.dtype)


def parameter_values(entry: PointInput | BoundInput) -> Floats:
    """The numbers that an input is bound to, in order: all of a bound input, the bound columns of the points."""
    if isinstance(entry, BoundInput):
        return np.asarray(entry.value, np.float64).reshape(-1)
    return entry.values[[column for column, coordinate in enumerate(entry.columns) if coordinate < 0]]


@dataclass(frozen=True)
class Output:
    """Where the field is: ``axis`` counts the points (None for a model of one point), ``channel`` those of a point."""

    name: str
    axis: int | None
    channel: int


@dataclass(frozen=True, eq=False)
class Layout:
    """The inputs of a model in order, the dimension of the points, and the chosen output.

    ``batch``: how many points the model takes at once, None for any number.
    """

    inputs: tuple[PointInput | BoundInput, ...]
    dim: int
    batch: int | None
    output: Output

    def feeds(self, points: Floats) -> Feeds:
        """The inputs of the model for ``points`` [n, dim], by name; with a static batch, ``n`` must be ``batch``."""
        n = len(points)
        if self.batch not in (None, n):
            raise ValueError(f"the model takes {self.batch} points at once, not {n}")
        feeds: Feeds = {}
        for entry in self.inputs:
            if isinstance(entry, BoundInput):
                feeds[entry.name] = entry.array(n)
                continue
            columns = points
            if entry.columns != tuple(range(self.dim)):
                columns = np.tile(entry.values, (n, 1))
                moving = [k for k, coordinate in enumerate(entry.columns) if coordinate >= 0]
                columns[:, moving] = points[:, [entry.columns[k] for k in moving]]
            feeds[entry.name] = np.array(entry.arrange(columns), entry.dtype, order="C")
        return feeds

    def take(self, values: np.ndarray) -> Floats:
        """The field [n], from the chosen output of the model."""
        array = np.asarray(values)
        rows = array.reshape(1, -1) if self.output.axis is None else np.moveaxis(array, self.output.axis, 0)
        return rows.reshape(len(rows), -1)[:, self.output.channel].astype(np.float64)

    def evaluate(self, run: Callable[[Feeds], Mapping[str, np.ndarray]], points: Floats) -> Floats:
        """The field [n] at ``points`` [n, dim]; ``run`` maps inputs to outputs by name.

        A model with a static batch is run in parts, of which the last is filled up with copies of its last point.
        """
        if self.batch is None:
            return self.take(run(self.feeds(points))[self.output.name])
        parts = []
        for start in range(0, len(points), self.batch):
            part = points[start : start + self.batch]
            filled = np.concatenate([part, np.repeat(part[-1:], self.batch - len(part), 0)])
            parts.append(self.take(run(self.feeds(filled))[self.output.name])[: len(part)])
        return np.concatenate(parts) if parts else np.zeros(0)


def point_count(shape: tuple[int | None, ...], axis: int | None) -> int | None:
    """How many points a shape holds; None if any number."""
    sizes = [size for i, size in enumerate(shape) if i != axis]
    return None if None in sizes else math.prod(size for size in sizes if size is not None)
