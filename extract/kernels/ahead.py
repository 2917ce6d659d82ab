"""Kernels that `march` calls last and that take longest to compile, compiled by themselves.

A second process does that, so that the first one finds them in numba's cache when it gets there. Should it get there
before, it compiles them too, and nothing is lost.
"""

from __future__ import annotations

from numba import types

from mn_onnx.extract.kernels.fold import fold
from mn_onnx.extract.kernels.records import Tables
from mn_onnx.extract.kernels.shave import shave_cell

_FLOATS, _INTEGERS = types.CPointer(types.float64), types.CPointer(types.int64)
_NUMBER = types.int64
_TABLES = types.NamedTuple(
    (_INTEGERS, _FLOATS, _INTEGERS, _FLOATS, _FLOATS, _INTEGERS, _INTEGERS, _NUMBER, types.float64), Tables
)


def compile_ahead() -> None:
    """Compile `fold` and `shave_cell` for the arguments that `march.visit` has for them."""
    arrays = (_FLOATS, _INTEGERS, _FLOATS, _INTEGERS, _NUMBER)  # F, N, X, J, M
    fold.compile((*arrays, *[_NUMBER] * 5))
    scratch = (_FLOATS, _INTEGERS, _INTEGERS)  # S, K, control
    shave_cell.compile((*arrays, *scratch, _TABLES, _INTEGERS, *[_NUMBER] * 5))
