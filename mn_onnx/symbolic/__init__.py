"""Tensors whose elements are functions of one point: what the importer computes with in place of numbers.

An element is ``scale * function(t) + offset``, where ``t`` is a *base*: an affine row over the variables of one point
(its coordinates, then unit outputs). Bases and functions are numbers of entries in a `mn_onnx.symbolic.store.Store`.
Elements of different points that compute the same function hold the same entries and differ in ``point`` alone.
Coordinates may be parameters, the same for all points: elements of parameters alone depend on no point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NO_POINT = -1
CONSTANT = -1
"""The base of elements that are numbers, held in ``offset``. Bases below are refused: see `Store.refuse`."""
IDENTITY = 0
"""The function of linear elements."""
SIZE_LIMIT = 1 << 24
"""Most elements that a tensor may have: a hostile or misread shape must not exhaust the memory."""


class TooLargeError(ValueError):
    """A tensor would have more than `SIZE_LIMIT` elements."""


def check_size(shape: Sequence[int]) -> None:
    """Raise `TooLargeError` if a tensor of this shape is larger than `SIZE_LIMIT`."""
    if math.prod(int(size) for size in shape) > SIZE_LIMIT:
        raise TooLargeError(f"a tensor of shape {[int(size) for size in shape]} is too large to be analysed")


def is_float(dtype: np.dtype) -> bool:
    """Whether ``dtype`` holds real numbers; true for bfloat16 and the 8-bit floats as well."""
    return dtype.kind == "f" or dtype.name.startswith(("bfloat", "float"))


@dataclass(frozen=True, eq=False)
class Constant:
    """A tensor of known values. Real numbers are kept as float64, whatever their ``dtype`` in the graph."""

    array: Array
    dtype: np.dtype

    @classmethod
    def of(cls, array: Array, dtype: np.dtype | None = None) -> Constant:
        """Widen real numbers to float64; ``dtype`` is the type in the graph, by default that of ``array``."""
        declared = array.dtype if dtype is None else dtype
        return cls(array.astype(np.float64) if is_float(array.dtype) else array, declared)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.array.shape

    @property
    def declared(self) -> Array:
        """The values as the graph has them: real numbers rounded to their type."""
        return self.array.astype(self.dtype)


@dataclass(frozen=True, eq=False)
class Opaque:
    """A tensor of which not even the shape is known; ``problems`` are the numbers of the reasons."""

    problems: frozenset[int]


@dataclass(frozen=True, eq=False)
class Tensor:
    """A tensor of elements; the five arrays have its shape.

    ``point`` int32: the point an element depends on, `NO_POINT` for numbers and functions of parameters alone;
    ``base`` int64; ``function`` int32; ``scale``, ``offset`` float64. ``dtype`` is the type in the graph; elements of
    boolean tensors have truth-valued functions with scale 1 and offset 0.
    """

    point: NDArray[np.int32]
    base: NDArray[np.int64]
    function: NDArray[np.int32]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    dtype: np.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        return self.base.shape

    @property
    def size(self) -> int:
        return self.base.size

    @property
    def live(self) -> NDArray[np.bool_]:
        """Where the element is no number: it depends on its point or on parameters."""
        return self.base >= 0

    @property
    def refused(self) -> NDArray[np.bool_]:
        return self.base < CONSTANT

    def map(self, change: Callable[[Array], Array]) -> Tensor:
        """Apply the same rearrangement to all fields."""
        return join([self], lambda fields: change(fields[0]))

    def __getitem__(self, index: Any) -> Tensor:
        """The elements at a numpy index."""
        return self.map(lambda field: field[index])

    def take(self, index: NDArray[np.int64]) -> Tensor:
        """The elements at flat positions ``index``, in its shape."""
        check_size(index.shape)
        return self.map(lambda field: field.reshape(-1)[index])

    def reshape(self, *shape: int) -> Tensor:
        return self.map(lambda field: field.reshape(shape))

    def with_dtype(self, dtype: np.dtype) -> Tensor:
        return Tensor(self.point, self.base, self.function, self.scale, self.offset, dtype)

    def broadcast(self, shape: tuple[int, ...]) -> Tensor:
        if shape == self.shape:
            return self
        check_size(shape)
        return self.map(lambda field: np.broadcast_to(field, shape))


Value = Constant | Tensor | Opaque


def lift(value: Constant | Tensor) -> Tensor:
    """A constant as a tensor of number elements; a tensor as it is."""
    if isinstance(value, Tensor):
        return value
    offset = np.asarray(value.array, np.float64)
    check_size(offset.shape)
    shape = offset.shape
    return Tensor(
        np.full(shape, NO_POINT, np.int32),
        np.full(shape, CONSTANT, np.int64),
        np.zeros(shape, np.int32),
        np.zeros(shape),
        offset,
        value.dtype,
    )


def lower(tensor: Tensor) -> Constant | Tensor:
    """A tensor of numbers alone as a constant; other tensors as they are."""
    if not (tensor.base == CONSTANT).all():
        return tensor
    if is_float(tensor.dtype):
        return Constant(tensor.offset, tensor.dtype)
    return Constant(tensor.offset.astype(tensor.dtype), tensor.dtype)


def join(tensors: Sequence[Tensor], combine: Callable[[list[Array]], Array]) -> Tensor:
    """Combine tensors field by field into one of the type of the first; ``combine`` must treat all fields alike."""
    return Tensor(
        combine([tensor.point for tensor in tensors]),
        combine([tensor.base for tensor in tensors]),
        combine([tensor.function for tensor in tensors]),
        combine([tensor.scale for tensor in tensors]),
        combine([tensor.offset for tensor in tensors]),
        tensors[0].dtype,
    )


def rearrange(value: Constant | Tensor, change: Callable[[Array], Array]) -> Constant | Tensor:
    """Move elements by ``change``, a function of numpy arrays that only reorders, repeats or drops elements."""
    if isinstance(value, Constant):
        return Constant(np.asarray(change(value.array)), value.dtype)
    positions = np.arange(value.size).reshape(value.shape)
    return value.take(np.asarray(change(positions)))


def concatenate(values: Sequence[Constant | Tensor], axis: int) -> Constant | Tensor:
    """Join along an axis; constants stay constants if all are."""
    dtype = values[0].dtype
    check_size((sum(math.prod(value.shape) for value in values),))
    constants = [value.array for value in values if isinstance(value, Constant)]
    if len(constants) == len(values):
        return Constant(np.concatenate(constants, axis), dtype)
    return join([lift(value) for value in values], lambda fields: np.concatenate(fields, axis))


def part(value: Constant | Tensor, axis: int, start: int, size: int) -> Constant | Tensor:
    """``size`` slices along an axis, from ``start`` on."""
    index = (*(slice(None) for _ in range(axis)), slice(start, start + size))
    return rearrange(value, lambda array: array[index])


def groups(*keys: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Partition positions by equal keys.

    ``keys``: arrays [n]. Returns the first position of every group [g] and the group of every position [n].
    """
    n = len(keys[0])
    code = np.zeros(n, np.int64)
    for key in keys:
        if n and not (key == key[0]).all():
            numbers = _numbered(key)
            code = _numbered(code * (int(numbers.max()) + 1) + numbers)
    first = np.zeros(int(code.max()) + 1 if n else 0, np.int64)
    # Of several assignments to one place the last one holds.
    first[code[::-1]] = np.arange(n - 1, -1, -1)
    return first, code


def _numbered(key: Array) -> NDArray[np.int64]:
    """The values of a key replaced by consecutive numbers in increasing order."""
    if key.dtype.kind in "bi":
        integers = key.astype(np.int64)
        lowest = int(integers.min())
        extent = int(integers.max()) - lowest + 1
        if extent <= 4 * key.size + 1024:
            # A table is several times faster than sorting.
            present = np.zeros(extent, np.int64)
            present[integers - lowest] = 1
            return (np.cumsum(present) - 1)[integers - lowest]
    return np.unique(key, return_inverse=True)[1]
