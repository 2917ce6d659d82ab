"""Kernels that `march` calls late and that take long to compile, compiled by themselves, in the order of its calls.

A second process does that, so that the first one finds them in numba's cache when it gets there. Should it get there
before, it compiles them too, and nothing is lost.
"""

from __future__ import annotations

from numba import types

from mn_onnx.extract.kernels.bound import bound_output
from mn_onnx.extract.kernels.leaf import emit_leaf
from mn_onnx.extract.kernels.records import OutputArrays, Tables
from mn_onnx.extract.kernels.shave import shave_cell
from mn_onnx.extract.kernels.split import trim_cell

_FLOATS, _INTEGERS = types.CPointer(types.float64), types.CPointer(types.int64)
_NUMBER, _VALUE = types.int64, types.float64
_TABLES = types.NamedTuple(
    (_INTEGERS, _FLOATS, _INTEGERS, _FLOATS, _FLOATS, _INTEGERS, _INTEGERS, _NUMBER, _VALUE), Tables
)
_POINTS, _FACES = types.CPointer(types.int32), types.CPointer(types.int8)
_OUTPUT = types.NamedTuple((_INTEGERS, _POINTS, _FLOATS, _POINTS, _FLOATS, _INTEGERS, _FACES, _POINTS), OutputArrays)


def compile_ahead() -> None:
    """Compile these kernels for the arguments that `march.visit` has for them."""
    bound_output.compile((_FLOATS, _INTEGERS, _FLOATS, _NUMBER, _VALUE, *[_NUMBER] * 3, _VALUE))
    arrays = (_FLOATS, _INTEGERS, _FLOATS, _INTEGERS, _NUMBER)  # F, N, X, J, M
    trim_cell.compile((*arrays, _INTEGERS, _TABLES, _INTEGERS, *[_NUMBER] * 2, *[_VALUE] * 4))
    scratch = (_FLOATS, _INTEGERS, _INTEGERS)  # S, K, control
    shave_cell.compile((*arrays, *scratch, _TABLES, _INTEGERS, *[_NUMBER] * 6))
    emit_leaf.compile((*arrays, _OUTPUT, _TABLES, _INTEGERS, *[_NUMBER] * 4))
