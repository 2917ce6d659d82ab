"""Four or eight float64 values in one vector register, for compiled kernels.

LLVM's loop vectoriser guards every short loop over arrays with run-time alias checks, which cost more than loops of
four to thirty steps gain. Here the vector operations are written out, so that a kernel's inner loop is exactly its
loads and fused multiply-adds. Every machine LLVM knows can run them; one without registers this wide splits them.

Loads and stores are unaligned and unchecked: callers pad to a multiple of `WIDTH`.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

WIDTH = 4
WIDE = 8
SINGLES = 16

_INT32 = ir.IntType(32)


class LanesType(types.Type):
    """The numba type of a vector of ``width`` numbers of an element type, float64 or float32."""

    def __init__(self, width: int, element: Any) -> None:
        super().__init__(name=f"Lanes{width}{element}")
        self.vector = ir.VectorType(element, width)


lanes = LanesType(WIDTH, ir.DoubleType())
wide_lanes = LanesType(WIDE, ir.DoubleType())
wide_singles = LanesType(WIDE, ir.FloatType())
singles = LanesType(SINGLES, ir.FloatType())


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: LanesType) -> None:
        super().__init__(manager, numba_type, numba_type.vector)


def _vector_pointer(builder: Any, vector: Any, pointer: Any, index: Any) -> Any:
    return builder.bitcast(builder.gep(pointer, [index]), vector.as_pointer())


def _call(builder: Any, name: str, vector: Any, arguments: list[Any]) -> Any:
    signature = ir.FunctionType(vector, [vector] * len(arguments))
    bits = 64 if vector.element == ir.DoubleType() else 32
    function = cgutils.get_or_insert_function(builder.module, signature, f"llvm.{name}.v{vector.count}f{bits}")
    return builder.call(function, arguments)


def _shuffle(builder: Any, vector: Any, order: list[int]) -> Any:
    mask = ir.Constant(ir.VectorType(_INT32, len(order)), order)
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), mask)


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
def as_singles(typing_context: Any, source: Any) -> Any:
    """The same memory as float32, two to every float64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType().as_pointer())

    return types.CPointer(types.float32)(source), code


@intrinsic
def load_singles(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + SINGLES]`` through a pointer to float32."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_vector_pointer(builder, singles.vector, *arguments), align=4)

    return singles(source, types.int64), code


@intrinsic
def load_eight(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + WIDE]`` through a pointer to float32."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_vector_pointer(builder, wide_singles.vector, *arguments), align=4)

    return wide_singles(source, types.int64), code


@intrinsic
def splat_singles(typing_context: Any, value: Any) -> Any:
    """The same number, rounded to float32, in `SINGLES` lanes."""
    return singles(types.float32), _splat


@intrinsic
def splat_eight(typing_context: Any, value: Any) -> Any:
    """The same float32 in `WIDE` lanes."""
    return wide_singles(types.float32), _splat


@intrinsic
def times(typing_context: Any, a: Any, b: Any) -> Any:
    """Products."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fmul(*arguments)

    return a(a, a), code


@intrinsic
def round_to_singles(typing_context: Any, values: Any) -> Any:
    """Eight float64 rounded to float32."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fptrunc(arguments[0], wide_singles.vector)

    return wide_singles(wide_lanes), code


@intrinsic
def as_doubles(typing_context: Any, values: Any) -> Any:
    """Eight float32 as float64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fpext(arguments[0], wide_lanes.vector)

    return wide_lanes(wide_singles), code


@intrinsic
def load(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + WIDTH]`` through a pointer."""
    return lanes(source, types.int64), load_plain


@intrinsic
def load_wide(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + WIDE]`` through a pointer."""
    return wide_lanes(source, types.int64), load_plain


@intrinsic
def load_like(typing_context: Any, like: Any, source: Any, index: Any) -> Any:
    """As many values of ``source`` from ``index`` on as ``like`` has lanes: for kernels of either width."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return load_plain(context, builder, signature, arguments[1:])

    return like(like, source, types.int64), code


def load_plain(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Code of a load whose type follows from the intrinsic's signature."""
    return builder.load(_vector_pointer(builder, signature.return_type.vector, *arguments), align=8)


@intrinsic
def store(typing_context: Any, target: Any, index: Any, value: Any) -> Any:
    """``target[index : index + width] = value`` through a pointer."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, index, value = arguments
        align = 8 if value.type.element == ir.DoubleType() else 4
        builder.store(value, _vector_pointer(builder, value.type, target, index), align=align)
        return context.get_dummy_value()

    return types.none(target, types.int64, value), code


@intrinsic
def store_transposed(typing_context: Any, target: Any, index: Any, stride: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Lane ``k`` of four `wide_singles`, one after the other, to ``target[index + k * stride]``, through a pointer."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, index, stride, *columns = arguments

        def shuffle(left: Any, right: Any, order: list[int]) -> Any:
            return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_INT32, len(order)), order))

        rows = []
        for k in (0, 2):
            # In both halves of a register: lanes k and k + 1 of two columns by turns, then of four.
            turns = [k + lane + column for lane in (0, 1, 4, 5) for column in (0, WIDE)]
            left, right = shuffle(*columns[:2], turns), shuffle(*columns[2:], turns)
            fours = ([j + lane for lane in (0, 1, 8, 9, 4, 5, 12, 13)] for j in (0, 2))
            rows.extend(shuffle(left, right, order) for order in fours)
        for half in ([0, 1, 2, 3], [4, 5, 6, 7]):
            for row in rows:
                part = shuffle(row, row, half)
                builder.store(part, _vector_pointer(builder, part.type, target, index), align=4)
                index = builder.add(index, stride)
        return context.get_dummy_value()

    return types.none(target, types.int64, types.int64, a, b, c, d), code


@intrinsic
def prefetch(typing_context: Any, source: Any, index: Any) -> Any:
    """Ask for the cache line of ``source[index]`` to be brought into the second cache; any index is allowed."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = builder.bitcast(builder.gep(arguments[0], [arguments[1]]), ir.IntType(8).as_pointer())
        signature = ir.FunctionType(ir.VoidType(), [address.type, _INT32, _INT32, _INT32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], signature)
        builder.call(function, [address, *(ir.Constant(_INT32, number) for number in (0, 2, 1))])
        return context.get_dummy_value()

    return types.none(source, types.int64), code


@intrinsic
def splat(typing_context: Any, value: Any) -> Any:
    """The same number in `WIDTH` lanes."""
    return lanes(types.float64), _splat


@intrinsic
def splat_wide(typing_context: Any, value: Any) -> Any:
    """The same number in `WIDE` lanes."""
    return wide_lanes(types.float64), _splat


@intrinsic
def splat_like(typing_context: Any, like: Any, value: Any) -> Any:
    """The same number in as many lanes as ``like`` has."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _splat(context, builder, signature, arguments[1:])

    return like(like, types.float64), code


def _splat(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return shuffle_first(builder, signature.return_type.vector, arguments[0])


def shuffle_first(builder: Any, vector: Any, value: Any) -> Any:
    """One value in all lanes of a vector type."""
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(_INT32, 0))
    return _shuffle(builder, first, [0] * vector.count)


@intrinsic
def lanes_of(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Four numbers as the lanes of a register."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.Constant(lanes.vector, ir.Undefined)
        for k, value in enumerate(arguments):
            vector = builder.insert_element(vector, value, ir.Constant(_INT32, k))
        return vector

    return lanes(types.float64, types.float64, types.float64, types.float64), code


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c``, fused where the machine can."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "fmuladd", arguments[0].type, list(arguments))

    return a(a, a, a), code


@intrinsic
def smaller(typing_context: Any, a: Any, b: Any) -> Any:
    """``a`` where ``a < b``, else ``b``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return a(a, a), code


@intrinsic
def larger(typing_context: Any, a: Any, b: Any) -> Any:
    """``a`` where ``a > b``, else ``b``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return a(a, a), code


@intrinsic
def magnitude(typing_context: Any, a: Any) -> Any:
    """``|a|``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "fabs", arguments[0].type, list(arguments))

    return a(a), code


@intrinsic
def total(typing_context: Any, a: Any) -> Any:
    """The sum of the lanes, added in pairs."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = arguments[0]
        while vector.type.count > 2:
            half = vector.type.count // 2
            low = _shuffle(builder, vector, list(range(half)))
            vector = builder.fadd(low, _shuffle(builder, vector, list(range(half, 2 * half))))
        ends = [builder.extract_element(vector, ir.Constant(_INT32, k)) for k in range(2)]
        return builder.fadd(*ends)

    return (types.float32 if a == singles else types.float64)(a), code


@intrinsic
def halves(typing_context: Any, a: Any) -> Any:
    """The lower four of eight lanes plus the upper four."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        low, high = (_shuffle(builder, arguments[0], [first + k for k in range(WIDTH)]) for first in (0, WIDTH))
        return builder.fadd(low, high)

    return lanes(wide_lanes), code


@intrinsic
def totals(typing_context: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The sums of the lanes of four registers, in one."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def add(left: Any, right: Any, *orders: list[int]) -> Any:
            masks = (ir.Constant(ir.VectorType(_INT32, WIDTH), order) for order in orders)
            return builder.fadd(*(builder.shuffle_vector(left, right, mask) for mask in masks))

        pairs = [add(*arguments[k : k + 2], [0, 4, 2, 6], [1, 5, 3, 7]) for k in (0, 2)]
        return add(*pairs, [0, 1, 4, 5], [2, 3, 6, 7])

    return lanes(lanes, lanes, lanes, lanes), code


@intrinsic
def lane(typing_context: Any, value: Any, index: Any) -> Any:
    """One lane as a float64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.extract_element(arguments[0], builder.trunc(arguments[1], _INT32))

    return types.float64(value, types.int64), code


@intrinsic
def cycles(typing_context: Any) -> Any:
    """The machine's cycle counter, for profiles."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = ir.FunctionType(ir.IntType(64), [])
        return builder.call(cgutils.get_or_insert_function(builder.module, counter, "llvm.readcyclecounter"), [])

    return types.int64(), code
