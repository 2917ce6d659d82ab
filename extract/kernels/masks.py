"""Decisions on eight rows at once: integers and masks in vector registers, for compiled kernels.

Which state a unit takes is as good as random, and a branch guessed wrong costs more than deciding eight rows without
any. `pack` moves the chosen lanes to the front, which is how lists are made of some of the rows.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from mn_onnx.extract.kernels.lanes import WIDE, load_plain, shuffle_first, wide_lanes

_INT64 = ir.IntType(64)
_INT32 = ir.IntType(32)
_BITS = ir.IntType(WIDE)


class VectorType(types.Type):
    """The numba type of a vector that holds something else than float64."""

    def __init__(self, name: str, element: Any) -> None:
        super().__init__(name=name)
        self.vector = ir.VectorType(element, WIDE)


integer_lanes = VectorType("IntegerLanes", _INT64)
mask_lanes = VectorType("MaskLanes", ir.IntType(1))


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: VectorType) -> None:
        super().__init__(manager, numba_type, numba_type.vector)


@intrinsic
def load_integers(typing_context: Any, source: Any, index: Any) -> Any:
    """``source[index : index + WIDE]`` through a pointer to int64."""
    return integer_lanes(source, types.int64), load_plain


@intrinsic
def splat_integer(typing_context: Any, value: Any) -> Any:
    """The same int64 in all lanes."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return shuffle_first(builder, integer_lanes.vector, arguments[0])

    return integer_lanes(types.int64), code


@intrinsic
def count_up(typing_context: Any, first: Any) -> Any:
    """``first``, ``first`` + 1, and so on."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        steps = ir.Constant(integer_lanes.vector, list(range(WIDE)))
        return builder.add(shuffle_first(builder, integer_lanes.vector, arguments[0]), steps)

    return integer_lanes(types.int64), code


@intrinsic
def multiply(typing_context: Any, a: Any, b: Any) -> Any:
    """Products of integers."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.mul(*arguments)

    return integer_lanes(integer_lanes, integer_lanes), code


@intrinsic
def divide(typing_context: Any, a: Any, b: Any) -> Any:
    """Quotients of float64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fdiv(*arguments)

    return wide_lanes(wide_lanes, wide_lanes), code


def _comparison(ordered: str, typing_context: Any, a: Any, b: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if a == integer_lanes:
            return builder.icmp_signed(ordered, *arguments)
        return builder.fcmp_ordered(ordered, *arguments)

    return mask_lanes(a, a), code


@intrinsic
def is_below(typing_context: Any, a: Any, b: Any) -> Any:
    """Where ``a < b``; nowhere for NaN."""
    return _comparison("<", typing_context, a, b)


@intrinsic
def at_least(typing_context: Any, a: Any, b: Any) -> Any:
    """Where ``a >= b``; nowhere for NaN."""
    return _comparison(">=", typing_context, a, b)


@intrinsic
def same(typing_context: Any, a: Any, b: Any) -> Any:
    """Where ``a == b``; nowhere for NaN."""
    return _comparison("==", typing_context, a, b)


@intrinsic
def both(typing_context: Any, a: Any, b: Any) -> Any:
    """Where two masks hold."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(*arguments)

    return mask_lanes(mask_lanes, mask_lanes), code


@intrinsic
def either(typing_context: Any, a: Any, b: Any) -> Any:
    """Where at least one of two masks holds."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.or_(*arguments)

    return mask_lanes(mask_lanes, mask_lanes), code


@intrinsic
def without(typing_context: Any, a: Any, b: Any) -> Any:
    """Where the first mask holds and the second does not."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(arguments[0], builder.not_(arguments[1]))

    return mask_lanes(mask_lanes, mask_lanes), code


@intrinsic
def choose(typing_context: Any, mask: Any, a: Any, b: Any) -> Any:
    """``a`` where the mask holds, else ``b``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return a(mask_lanes, a, a), code


@intrinsic
def bits_of(typing_context: Any, mask: Any) -> Any:
    """The mask as an int64: bit ``k`` for lane ``k``."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.bitcast(arguments[0], _BITS), _INT64)

    return types.int64(mask_lanes), code


@intrinsic
def mask_of(typing_context: Any, bits: Any) -> Any:
    """The mask of the lowest bits of an int64."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(builder.trunc(arguments[0], _BITS), mask_lanes.vector)

    return mask_lanes(types.int64), code


@intrinsic
def count_bits(typing_context: Any, bits: Any) -> Any:
    """How many bits of an int64 are set."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), code


@intrinsic
def count_before(typing_context: Any, bits: Any, first: Any) -> Any:
    """For every lane ``first`` plus the number of bits set for the lanes before it."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits, first = (shuffle_first(builder, integer_lanes.vector, argument) for argument in arguments)
        before = ir.Constant(integer_lanes.vector, [(1 << lane) - 1 for lane in range(WIDE)])
        kind = ir.FunctionType(bits.type, [bits.type])
        count = cgutils.get_or_insert_function(builder.module, kind, f"llvm.ctpop.v{WIDE}i64")
        return builder.add(first, builder.call(count, [builder.and_(bits, before)]))

    return integer_lanes(types.int64, types.int64), code


@intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """The place of the lowest bit that is set, of an int64 that is not zero."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), code


@intrinsic
def pack(typing_context: Any, value: Any, mask: Any) -> Any:
    """The lanes of eight float64 where the mask holds, moved to the front; what follows is anything."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector, mask = arguments
        if _packs(context):
            return _compress(builder, vector, mask, "f64")
        space = cgutils.alloca_once(builder, ir.ArrayType(vector.type.element, 2 * WIDE))
        place = builder.bitcast(space, vector.type.element.as_pointer())
        _store_lanes(builder, place, vector, mask)
        return builder.load(builder.bitcast(place, vector.type.as_pointer()), align=8)

    return wide_lanes(wide_lanes, mask_lanes), code


@intrinsic
def pack_store(typing_context: Any, target: Any, index: Any, value: Any, mask: Any) -> Any:
    """Write the lanes where the mask holds to ``target`` from ``index`` on, without gaps.

    Up to `WIDE` places of the target are overwritten, whatever the mask.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, index, vector, mask = arguments
        if _packs(context):
            packed = _compress(builder, vector, mask, "f64" if value == wide_lanes else "i64")
            place = builder.bitcast(builder.gep(target, [index]), vector.type.as_pointer())
            builder.store(packed, place, align=8)
            return context.get_dummy_value()
        _store_lanes(builder, builder.gep(target, [index]), vector, mask)
        return context.get_dummy_value()

    return types.none(target, types.int64, value, mask_lanes), code


def _packs(context: Any) -> bool:
    return "+avx512f" in context.codegen().magic_tuple()[2]


def _compress(builder: Any, vector: Any, mask: Any, suffix: str) -> Any:
    kind = ir.FunctionType(vector.type, [vector.type, vector.type, mask.type])
    name = f"llvm.x86.avx512.mask.compress.v{WIDE}{suffix}"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [vector, vector, mask])


def _store_lanes(builder: Any, place: Any, vector: Any, mask: Any) -> None:
    """What `pack` does, by single stores: every lane over the last one that is not in the mask."""
    for k in range(WIDE):
        at = ir.Constant(_INT32, k)
        builder.store(builder.extract_element(vector, at), place)
        place = builder.gep(place, [builder.zext(builder.extract_element(mask, at), _INT64)])
