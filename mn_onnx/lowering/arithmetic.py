"""Lowering of elementwise arithmetic, comparison, logic and type casts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx

from mn_onnx.ir.expression import Expression, apply, constant
from mn_onnx.lowering import formulas
from mn_onnx.lowering.context import Context
from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.lowering.table import Table, same
from mn_onnx.symbolic import Constant, Tensor, is_float, lift
from mn_onnx.symbolic.algebra import Algebra
from mn_onnx.symbolic.compose import BOOL

Binary = Callable[[Algebra, Tensor, Tensor], Tensor]
TRUE, FALSE = constant(1.0), constant(0.0)


def binary(operation: Binary) -> Callable[[Context, Node], Tensor]:
    """The lowering of an operator of two tensors."""

    def lower(context: Context, node: Node) -> Tensor:
        return operation(context.algebra, lift(node.tensor(0)), lift(node.tensor(1)))

    return lower


def n_ary(operation: Binary) -> Callable[[Context, Node], Tensor]:
    """One or more operands, joined pairwise in a balanced tree, which keeps the chain of units short."""

    def lower(context: Context, node: Node) -> Tensor:
        operands = [lift(node.tensor(index)) for index in range(len(node.inputs))]
        return balanced(operands, lambda x, y: operation(context.algebra, x, y))

    return lower


def balanced(operands: list[Tensor], join: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Join tensors pairwise until one is left."""
    while len(operands) > 1:
        joined = [join(x, y) for x, y in zip(operands[::2], operands[1::2], strict=False)]
        operands = joined + operands[len(operands) - len(operands) % 2 :]
    return operands[0]


def divide(context: Context, node: Node) -> Tensor:
    """Div of real numbers."""
    x, y = lift(node.tensor(0)), lift(node.tensor(1))
    if not is_float(x.dtype):
        raise UnsupportedNode("it divides integers that depend on the points, which rounds")
    return context.algebra.divide(x, y)


def mean(context: Context, node: Node) -> Tensor:
    """Mean of any number of tensors."""
    total = n_ary(Algebra.add)(context, node)
    return context.algebra.divide(total, lift(Constant.of(np.asarray(float(len(node.inputs))))))


def negate(context: Context, node: Node) -> Tensor:
    """Neg."""
    return context.algebra.multiply(lift(node.tensor(0)), lift(Constant.of(np.asarray(-1.0))))


def power(context: Context, node: Node) -> Tensor:
    """Pow with a constant exponent, or a positive constant base."""
    x, exponent = lift(node.tensor(0)), lift(node.tensor(1))
    if exponent.refused.any() or x.refused.any():
        return context.algebra.apply([x, exponent], _power)
    if exponent.live.any() and x.live.any():
        raise UnsupportedNode("base and exponent both depend on the points; a power needs one of them constant")
    if (exponent.base == -1).all() and (exponent.offset == 1.0).all():
        return x.broadcast(np.broadcast_shapes(x.shape, exponent.shape))
    return context.algebra.apply([x, exponent], _power)


def _power(x: Expression, exponent: Expression) -> Expression:
    if exponent.op == "constant":
        if exponent.value in (0.0, 1.0):
            return x if exponent.value else TRUE
        return apply("sqrt", x) if exponent.value == 0.5 else apply("power", x, exponent)
    if x.op == "constant" and x.value > 0.0:
        return apply("exp", apply("multiply", constant(float(np.log(x.value))), exponent))
    raise UnsupportedNode("a power with a variable exponent needs a positive constant base")


def modulo(context: Context, node: Node) -> Tensor:
    """Mod, with the sign of the divisor or, with ``fmod``, of the dividend."""
    like_c = bool(node.attribute("fmod", 0))
    return context.algebra.apply(
        [lift(node.tensor(0)), lift(node.tensor(1))], lambda x, y: formulas.remainder(x, y, like_c)
    )


def comparison(operation: str, *, swap: bool = False) -> Callable[[Context, Node], Tensor]:
    """The lowering of a comparison; ``swap`` exchanges the operands."""

    def lower(context: Context, node: Node) -> Tensor:
        x, y = lift(node.tensor(0)), lift(node.tensor(1))
        return context.algebra.compare(y, x, operation) if swap else context.algebra.compare(x, y, operation)

    return lower


def where(context: Context, node: Node) -> Tensor:
    """Where."""
    return context.algebra.where(lift(node.tensor(0)), lift(node.tensor(1)), lift(node.tensor(2)))


def connective(build: Callable[..., Expression], n: int) -> Callable[[Context, Node], Tensor]:
    """The lowering of a logical operator of ``n`` tensors."""

    def lower(context: Context, node: Node) -> Tensor:
        return context.algebra.apply([lift(node.tensor(i)) for i in range(n)], build, BOOL)

    return lower


def conjunction(p: Expression, q: Expression) -> Expression:
    """``p and q``."""
    if p.op == "constant":
        return q if p.value else FALSE
    return conjunction(q, p) if q.op == "constant" else apply("and", p, q)


def disjunction(p: Expression, q: Expression) -> Expression:
    """``p or q``."""
    if p.op == "constant":
        return TRUE if p.value else q
    return disjunction(q, p) if q.op == "constant" else apply("or", p, q)


def negation(p: Expression) -> Expression:
    """``not p``."""
    return constant(float(not p.value)) if p.op == "constant" else apply("not", p)


def difference(p: Expression, q: Expression) -> Expression:
    """Exclusive or."""
    return conjunction(disjunction(p, q), negation(conjunction(p, q)))


def cast(context: Context, node: Node) -> Constant | Tensor:
    """Cast to the type in the attribute ``to``."""
    target = node.attribute("to")
    # Before opset 6 the type is given by name.
    code = onnx.TensorProto.DataType.Value(target) if isinstance(target, str) else int(target)
    if code == onnx.TensorProto.STRING:
        raise UnsupportedNode("strings are not supported")
    return convert(context, node.tensor(0), np.dtype(onnx.helper.tensor_dtype_to_np_dtype(code)))


def cast_like(context: Context, node: Node) -> Constant | Tensor:
    """Cast to the type of the second input."""
    return convert(context, node.tensor(0), node.tensor(1).dtype)


def convert(context: Context, x: Constant | Tensor, dtype: np.dtype) -> Constant | Tensor:
    """Change the type. Constants are rounded as in the graph; data stay real numbers, whatever their float type."""
    if isinstance(x, Constant):
        return Constant.of(x.declared.astype(dtype), dtype)
    if x.dtype == BOOL:
        number = x if dtype == BOOL else context.algebra.unary(x, formulas.truth_as_number)
        return number.with_dtype(dtype)
    if dtype == BOOL:
        return context.algebra.apply([x], lambda e: apply("not", apply("equal", e, constant(0.0))), BOOL)
    if is_float(dtype):
        if dtype.itemsize < 2:
            raise UnsupportedNode(f"it rounds data to {dtype.name}", "export the network before quantisation")
        return x.with_dtype(dtype)
    rounded = context.algebra.unary(x, formulas.truncate) if is_float(x.dtype) else x
    return rounded.with_dtype(dtype)


LOWERINGS: Table = {
    "Add": same(binary(Algebra.add), 7),
    "Sub": same(binary(lambda a, x, y: a.add(x, y, -1.0)), 7),
    "Mul": same(binary(Algebra.multiply), 7),
    "Div": same(divide, 7),
    "Neg": same(negate),
    "Pow": same(power, 7, "surrogate"),
    "Mod": same(modulo, 10),
    "Sum": same(n_ary(Algebra.add)),
    "Mean": same(mean),
    "Max": same(n_ary(lambda a, x, y: a.extremum(x, y, "maximum"))),
    "Min": same(n_ary(lambda a, x, y: a.extremum(x, y, "minimum"))),
    "Less": same(comparison("less"), 7),
    "Greater": same(comparison("less", swap=True), 7),
    "LessOrEqual": same(comparison("less_equal"), 12),
    "GreaterOrEqual": same(comparison("less_equal", swap=True), 12),
    "Equal": same(comparison("equal"), 7),
    "Where": same(where, 9),
    "And": same(connective(conjunction, 2), 7),
    "Or": same(connective(disjunction, 2), 7),
    "Xor": same(connective(difference, 2), 7),
    "Not": same(connective(negation, 1)),
    "Cast": same(cast, on_constants=True),
    "CastLike": same(cast_like, 15, on_constants=True),
}
