"""Four float64 values in one vector register, for compiled kernels.

LLVM's loop vectoriser guards every short loop over arrays with run-time alias checks, which cost more than loops of
four to thirty steps gain. Here the vector operations are written out, so that a kernel's inner loop is exactly its
loads and fused multiply-adds. Every machine LLVM knows can run them; one without 256-bit registers splits them.

`load` and `store` are unaligned and unchecked: callers pad to a multiple of `WIDTH`.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

WIDTH = 4

_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class LanesType(types.Type):
    """The numba type of a vector of `WIDTH` float64."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _vector_pointer(builder: Any, pointer: Any, index: Any) -> Any:
    return builder.bitcast(builder.gep(pointer, [index]), _VECTOR.as_pointer())


def _call(builder: Any, name: str, arguments: list[Any]) -> Any:
    signature = ir.FunctionType(_VECTOR, [_VECTOR] * len(arguments))
    function = cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{WIDTH}f64")
    return builder.call(function, arguments)


@intrinsic
def pointer(typing_context: Any, array: Any) -> Any:
    """The address of a C-contiguous array's first element; index it as a flat array.

    An index through a pointer is one instruction, where an array's handles negative indices; and passing a pointer on
    costs neither the array's seven words nor its reference count. The caller keeps the array alive.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), code


@intrinsic
def load(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + WIDTH]`` through a pointer."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_vector_pointer(builder, *arguments), align=8)

    return lanes(source, types.int64), code


@intrinsic
def store(typing_context: Any, target: Any, index: Any, value: Any) -> Any:
    """``target[index : index + WIDTH] = value`` through a pointer."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _vector_pointer(builder, arguments[0], arguments[1]), align=8)
        return context.get_dummy_value()

    return types.none(target, types.int64, lanes), code


@intrinsic
def splat(typing_context: Any, value: Any) -> Any:
    """The same number in every lane."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        zero = ir.Constant(ir.IntType(32), 0)
        first = builder.insert_element(undefined, arguments[0], zero)
        order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(first, undefined, order)

    return lanes(types.float64), code


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c``, fused where the machine can."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "fmuladd", list(arguments))

    return lanes(lanes, lanes, lanes), code


@intrinsic
def smaller(typing_context: Any, a: Any, b: Any) -> Any:
    """``a`` where ``a < b``, else ``b``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return lanes(lanes, lanes), code


@intrinsic
def larger(typing_context: Any, a: Any, b: Any) -> Any:
    """``a`` where ``a > b``, else ``b``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return lanes(lanes, lanes), code


@intrinsic
def magnitude(typing_context: Any, a: Any) -> Any:
    """``|a|``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "fabs", list(arguments))

    return lanes(lanes), code


@intrinsic
def lane(typing_context: Any, value: Any, index: Any) -> Any:
    """One lane as a float64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.extract_element(arguments[0], builder.trunc(arguments[1], ir.IntType(32)))

    return types.float64(lanes, types.int64), code


@intrinsic
def cycles(typing_context: Any) -> Any:
    """The machine's cycle counter, for profiles."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = ir.FunctionType(ir.IntType(64), [])
        return builder.call(cgutils.get_or_insert_function(builder.module, counter, "llvm.readcyclecounter"), [])

    return types.int64(), code
