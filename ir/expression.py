"""Scalar functions of one variable as expression trees: what a unit computes before it becomes a knot table."""

from __future__ import annotations

from dataclasses import dataclass

ARITY: dict[str, int] = {
    "t": 0, "constant": 0,
    "add": 2, "subtract": 2, "multiply": 2, "divide": 2, "power": 2, "maximum": 2, "minimum": 2,
    "negate": 1, "abs": 1, "sign": 1, "exp": 1, "log": 1, "sqrt": 1, "reciprocal": 1,
    "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1,
    "sinh": 1, "cosh": 1, "tanh": 1, "asinh": 1, "acosh": 1, "atanh": 1,
    "sigmoid": 1, "softplus": 1, "erf": 1, "floor": 1, "ceil": 1, "round": 1,
    "less": 2, "less_equal": 2, "equal": 2, "and": 2, "or": 2, "not": 1, "where": 3,
}  # fmt: skip


@dataclass(frozen=True)
class Expression:
    """``op`` applied to ``arguments``; ``value`` is the number of a ``"constant"``. ``"t"`` is the variable.

    ``less``, ``less_equal``, ``equal``, ``and``, ``or`` and ``not`` give truth values, which only these ops and the
    first argument of ``where`` may read. ``power`` takes a constant exponent as its second argument.

    Raises ``ValueError`` for an op not in `ARITY` or a wrong number of arguments.
    """

    op: str
    arguments: tuple[Expression, ...] = ()
    value: float = 0.0

    def __post_init__(self) -> None:
        if ARITY.get(self.op) != len(self.arguments):
            raise ValueError(f"scalar operation {self.op!r} with {len(self.arguments)} arguments is not defined")


T = Expression("t")


def constant(value: float) -> Expression:
    """The constant function."""
    return Expression("constant", (), float(value))


def apply(op: str, *arguments: Expression) -> Expression:
    """``op`` applied to ``arguments``."""
    return Expression(op, arguments)
