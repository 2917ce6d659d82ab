"""Elementwise arithmetic on symbolic tensors.

Functions of one direction are composed as scalar expressions. Functions of different directions can be added (each
nonlinear one becomes a unit), compared (through their difference), and joined by maximum and minimum; their product is no
affine combination and is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar import UndefinedFunction, discontinuities, evaluate, simplify
from mn_onnx.symbolic import CONSTANT, IDENTITY, NO_POINT, Tensor, check_size, groups
from mn_onnx.symbolic_store import Rows, Store

Builder = Callable[..., Expression]
Mask = NDArray[np.bool_]

BOOL = np.dtype(bool)
STEP_RANGE = 64.0
"""Jumps of a function are looked for on ``[-STEP_RANGE, STEP_RANGE]``; further out the range of its unit decides."""


class Algebra:
    """Elementwise operations over one `Store`.

    ``report(node, reason, remedy)`` records a problem and returns its number; ``node`` is the label of the node being
    lowered, or of the one to blame. Operands are broadcast; results have their common shape.
    """

    def __init__(self, store: Store, report: Callable[[str, str, str], int]) -> None:
        self.store = store
        self.report = report
        self.node = ""
        self._step_refusals: dict[int, int | None] = {}

    # Linear operations

    def add(self, x: Tensor, y: Tensor, sign: float = 1.0) -> Tensor:
        """``x + sign * y``."""
        return self._binary(x, y, lambda a, b: self._add(a, b, sign))

    def _add(self, x: Tensor, y: Tensor, sign: float) -> Tensor:
        result = _copy(x)
        number_x, number_y = x.base == CONSTANT, y.base == CONSTANT
        result.offset[number_y] += sign * y.offset[number_y]
        only_y = number_x & ~number_y
        _assign(result, only_y, y)
        result.scale[only_y] = sign * y.scale[only_y]
        result.offset[only_y] = x.offset[only_y] + sign * y.offset[only_y]
        if (number_y & x.live).any():
            result = self._absorb_bias(result, number_y & x.live, x)
        if (only_y & y.live).any():
            result = self._absorb_bias(result, only_y & y.live, y)

        both = x.live & y.live
        same = both & (x.base == y.base) & (x.function == y.function)
        result.scale[same] = x.scale[same] + sign * y.scale[same]
        result.offset[same] = x.offset[same] + sign * y.offset[same]
        related = both & ~same & self._related(x, y)
        if related.any():
            _assign(result, related, self._add_related(_select(x, related), _select(y, related), sign), packed=True)
        apart = both & ~same & ~related
        if apart.any():
            _assign(result, apart, self._add_rows(_select(x, apart), _select(y, apart), sign), packed=True)
        return _drop_zero_scales(result)

    def _add_related(self, x: Tensor, y: Tensor, sign: float) -> Tensor:
        linear = (x.function == IDENTITY) & (y.function == IDENTITY)
        result = self._compose([x, y], lambda a, b: apply("add" if sign > 0 else "subtract", a, b), ~linear)
        ratio, shift = self._over(x.base[linear], y.base[linear])
        result.base[linear], result.function[linear] = x.base[linear], IDENTITY
        result.scale[linear] = x.scale[linear] + sign * y.scale[linear] * ratio
        result.offset[linear] = x.offset[linear] + sign * (y.offset[linear] + y.scale[linear] * shift)
        return result

    def _add_rows(self, x: Tensor, y: Tensor, sign: float) -> Tensor:
        x, y = self.settle(x), self.settle(y)
        result = _copy(x)
        refused = x.refused | y.refused
        for i in np.flatnonzero(refused).tolist():
            result.base[i] = self.store.refuse_together(np.array([x.base[i], y.base[i]]))
        good = ~refused
        n = int(good.sum())
        stacked = _stack(_select(x, good), _select(y, good))
        rows = self.store.rows(stacked, self.node)
        total = Rows(
            rows.columns, rows.matrix[:n] + sign * rows.matrix[n:], rows.constants[:n] + sign * rows.constants[n:]
        )
        result.base[good], result.function[good], result.scale[good], result.offset[good] = self.store.elements(total)
        return result

    def _absorb_bias(self, result: Tensor, mask: Mask, linear: Tensor) -> Tensor:
        """Make a layer's bias a part of the base, so that activations are functions of the whole pre-activation.

        A bias is what is added to a row that has no constant yet, or a vector of different numbers; a number added alike to
        all elements belongs to the formula of an activation, whose thresholds must stay exact.
        """
        mask = mask & (linear.function == IDENTITY)
        added = result.offset[mask] - linear.offset[mask]
        if not added.size:
            return result
        directions, scales, shifts = self.store.base_fields(linear.base[mask])
        multi = np.array([self.store.directions[number][0].size > 1 for number in directions.tolist()])
        untouched = multi & (linear.scale[mask] == 1.0) & (linear.offset[mask] == 0.0) & (shifts == 0.0)
        vector = bool((added != added[0]).any())
        for i, position in enumerate(np.flatnonzero(mask).tolist()):
            if vector or untouched[i]:
                scale = result.scale[position]
                result.base[position] = self.store.base(
                    int(directions[i]),
                    float(scale * scales[i]),
                    float(scale * shifts[i] + result.offset[position]),
                )
                result.scale[position], result.offset[position] = 1.0, 0.0
        return result

    def multiply(self, x: Tensor, y: Tensor) -> Tensor:
        """``x * y``."""
        return self._binary(x, y, self._multiply)

    def _multiply(self, x: Tensor, y: Tensor) -> Tensor:
        result = _copy(x)
        number_y = y.base == CONSTANT
        for scaled, factor, mask in ((x, y, number_y), (y, x, (x.base == CONSTANT) & ~number_y)):
            _assign(result, mask, scaled)
            result.scale[mask] = scaled.scale[mask] * factor.offset[mask]
            result.offset[mask] = scaled.offset[mask] * factor.offset[mask]
        both = x.live & y.live
        self._compose_or_refuse(result, x, y, both, lambda a, b: apply("multiply", a, b), "a product")
        return _drop_zero_scales(result)

    def divide(self, x: Tensor, y: Tensor) -> Tensor:
        """``x / y``."""
        return self._binary(x, y, self._divide)

    def _divide(self, x: Tensor, y: Tensor) -> Tensor:
        result = _copy(x)
        by_number = y.base == CONSTANT
        if (y.offset[by_number] == 0.0).any():
            raise ValueError("division by zero")
        result.scale[by_number] = x.scale[by_number] / y.offset[by_number]
        result.offset[by_number] = x.offset[by_number] / y.offset[by_number]
        self._compose_or_refuse(result, x, y, y.live, lambda a, b: apply("divide", a, b), "a quotient")
        return _drop_zero_scales(result)

    def _compose_or_refuse(self, result: Tensor, x: Tensor, y: Tensor, mask: Mask, build: Builder, what: str) -> None:
        related = mask & (~x.live | self._related(x, y))
        if related.any():
            _assign(result, related, self._compose([_select(x, related), _select(y, related)], build), packed=True)
        apart = mask & ~related
        if apart.any():
            problem = self.report(
                self.node,
                f"{what} of two different functions of the point is not piecewise linear",
                "if one factor comes from an extra input (a latent code, time), bind that input to constants",
            )
            result.base[apart] = self.store.refuse(problem)

    # Univariate functions

    def unary(self, x: Tensor, build: Builder) -> Tensor:
        """``build`` applied to every element."""
        return self.apply([x], build)

    def apply(self, operands: Sequence[Tensor], build: Builder, dtype: np.dtype | None = None) -> Tensor:
        """``build`` of elements that depend on the point through one direction at most; else refused."""
        shape = np.broadcast_shapes(*(operand.shape for operand in operands))
        check_size(shape)
        flat = [operand.broadcast(shape).reshape(-1) for operand in operands]
        related = np.ones(flat[0].size, np.bool_)
        for i, first in enumerate(flat):
            for second in flat[i + 1 :]:
                related &= ~(first.live & second.live) | self._related(first, second)

        def compose(*parts: Tensor) -> Tensor:
            return self._compose(list(parts), build)

        result = self._elementwise(flat, compose, related)
        return result.reshape(*shape).with_dtype(dtype or operands[0].dtype)

    def _compose(self, operands: list[Tensor], build: Builder, where: Mask | None = None) -> Tensor:
        """``build`` over flat operands whose live elements share a direction, element by element."""
        operands = [self._cut_large(operand) for operand in operands]
        n = operands[0].size
        base = np.full(n, CONSTANT, np.int64)
        for operand in reversed(operands):
            base = np.where(operand.live, operand.base, base)
        keys: list[np.ndarray] = []
        relations = []
        for operand in operands:
            ratio, shift = np.ones(n), np.zeros(n)
            other = operand.live & (operand.base != base)
            if other.any():
                ratio[other], shift[other] = self._over(base[other], operand.base[other])
            relations.append((ratio, shift))
            keys += [operand.live, operand.function, operand.scale, operand.offset, ratio, shift]
        function, scale, offset = np.zeros(n, np.int32), np.zeros(n), np.zeros(n)
        chosen = np.arange(n) if where is None else np.flatnonzero(where)
        first, member = groups(*(key[chosen] for key in keys)) if chosen.size else (np.zeros(0, np.int64), chosen)
        for group, position in enumerate(chosen[first].tolist()):
            parts = [
                self._expression(operand, position, relation)
                for operand, relation in zip(operands, relations, strict=True)
            ]
            expression = build(*parts)
            members = chosen[member == group]
            if all(part.op == "constant" for part in parts) or expression.op == "constant":
                base[members] = CONSTANT
                offset[members] = evaluate(expression, np.zeros(()))
            else:
                function[members] = self.store.function(expression, self.node)
                scale[members] = 1.0
        return Tensor(np.full(n, NO_POINT, np.int32), base, function, scale, offset, operands[0].dtype)

    def _expression(self, operand: Tensor, i: int, relation: tuple[np.ndarray, np.ndarray]) -> Expression:
        if not operand.live[i]:
            return constant(float(operand.offset[i]))
        inner = affine(T, float(relation[0][i]), float(relation[1][i]))
        outer = substitute(self.store.functions[operand.function[i]], inner)
        return affine(outer, float(operand.scale[i]), float(operand.offset[i]))

    def _cut_large(self, x: Tensor) -> Tensor:
        """Make units of functions that have grown too long to be composed further."""
        large = [i for i in np.flatnonzero(x.live).tolist() if self.store.is_large(int(x.function[i]))]
        if not large:
            return x
        result = _copy(x)
        for i in large:
            variable = self.store.unit(int(x.base[i]), int(x.function[i]), self.node)
            result.base[i], result.function[i] = self.store.variable_base(variable), IDENTITY
        return result

    # Comparison and choice

    def compare(self, x: Tensor, y: Tensor, operation: str) -> Tensor:
        """Truth of ``less``, ``less_equal`` or ``equal`` for every element."""

        def choose(a: Tensor, b: Tensor) -> Tensor:
            related = ~(a.live & b.live) | self._related(a, b)
            result = _copy(a)
            direct = self._compose([_select(a, related), _select(b, related)], lambda p, q: apply(operation, p, q))
            _assign(result, related, direct, packed=True)
            if not related.all():
                difference = self._add_rows(_select(a, ~related), _select(b, ~related), -1.0)
                outcome = self._elementwise(
                    [difference],
                    lambda d: self._compose([d], lambda p: apply(operation, p, constant(0.0))),
                )
                _assign(result, ~related, outcome, packed=True)
            return result

        return self._binary(x, y, choose).with_dtype(BOOL)

    def extremum(self, x: Tensor, y: Tensor, operation: str) -> Tensor:
        """``maximum`` or ``minimum`` of two tensors."""

        def choose(a: Tensor, b: Tensor) -> Tensor:
            related = ~(a.live & b.live) | self._related(a, b)
            result = _copy(a)
            direct = self._compose([_select(a, related), _select(b, related)], lambda p, q: apply(operation, p, q))
            _assign(result, related, direct, packed=True)
            if not related.all():
                left, right = _select(a, ~related), _select(b, ~related)
                excess = self._elementwise(
                    [self._add_rows(left, right, -1.0)],
                    lambda d: self._compose([d], lambda p: apply(operation, p, constant(0.0))),
                )
                total = self._elementwise([excess, right], lambda p, q: self._add(p, q, 1.0))
                _assign(result, ~related, total, packed=True)
            return result

        return self._binary(x, y, choose)

    def where(self, condition: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """``x`` where ``condition`` holds, else ``y``."""
        shape = np.broadcast_shapes(condition.shape, x.shape, y.shape)
        check_size(shape)
        c, a, b = (part.broadcast(shape).reshape(-1) for part in (condition, x, y))
        known = c.base == CONSTANT
        result = _copy(b)
        _assign(result, known & (c.offset != 0.0), a)
        open_ = ~known
        if open_.any():
            c, a, b = _select(c, open_), _select(a, open_), _select(b, open_)
            related = (~a.live | self._related(c, a)) & (~b.live | self._related(c, b)) & c.live
            chosen = _copy(b)
            _assign(chosen, related, self._choose(*(_select(p, related) for p in (c, a, b))), packed=True)
            if not related.all():
                c, a, b = (_select(p, ~related) for p in (c, a, b))
                difference = self.add(a, b, -1.0)
                gain = self.apply([c, difference], lambda t, d: apply("where", t, d, constant(0.0)), x.dtype)
                _assign(chosen, ~related, self.add(b, gain), packed=True)
            _assign(result, open_, chosen, packed=True)
        return result.reshape(*shape).with_dtype(x.dtype)

    def _choose(self, c: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return self._elementwise(
            [c, a, b],
            lambda *parts: self._compose(list(parts), lambda t, p, q: apply("where", t, p, q)),
        )

    # Shared machinery

    def settle(self, x: Tensor) -> Tensor:
        """Refuse elements whose function jumps: from here on they would enter sums."""
        return self.store.reject_steps(x, self._step_refusal)

    def _step_refusal(self, function: int) -> int | None:
        if not self.store.step_nodes[function]:
            return None
        if function not in self._step_refusals:
            reason = _jump(self.store.functions[function])
            self._step_refusals[function] = self._refuse_step(function, reason) if reason else None
        return self._step_refusals[function]

    def _refuse_step(self, function: int, reason: str) -> int:
        problem = self.report(
            self.store.step_nodes[function],
            f"the result is not a continuous function of the point: {reason}",
            "export the field before it is rounded, quantised, thresholded or classified",
        )
        return self.store.refuse(problem)

    def _related(self, x: Tensor, y: Tensor) -> Mask:
        """Where both are live and functions of the same direction."""
        both = x.live & y.live
        related = both & (x.base == y.base)
        rest = np.flatnonzero(both & ~related)
        if rest.size:
            bases = self.store.bases
            related[rest] = [
                bases[a].direction == bases[b].direction
                for a, b in zip(x.base[rest].tolist(), y.base[rest].tolist(), strict=True)
            ]
        return related

    def _over(self, reference: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(r, q)`` with ``base = r * reference + q``, for bases of one direction."""
        _, scale_reference, shift_reference = self.store.base_fields(reference)
        _, scale, shift = self.store.base_fields(base)
        ratio = scale / scale_reference
        return ratio, shift - ratio * shift_reference

    def _binary(self, x: Tensor, y: Tensor, compute: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        shape = np.broadcast_shapes(x.shape, y.shape)
        check_size(shape)
        flat = [x.broadcast(shape).reshape(-1), y.broadcast(shape).reshape(-1)]
        return self._elementwise(flat, compute).reshape(*shape).with_dtype(x.dtype)

    def _elementwise(
        self, operands: list[Tensor], compute: Callable[..., Tensor], allowed: Mask | None = None
    ) -> Tensor:
        """Run ``compute`` once per distinct combination of flat operands, and give the results their points.

        Combinations with a refused element, of different points, or not ``allowed``, are refused.
        """
        n = operands[0].size
        point = np.full(n, NO_POINT, np.int32)
        mixed = np.zeros(n, np.bool_)
        for operand in operands:
            mixed |= (point != NO_POINT) & operand.live & (operand.point != point)
            point = np.where(operand.live, operand.point, point)
        keys = [mixed]
        for operand in operands:
            keys += [operand.base, operand.function, operand.scale, operand.offset]
        first, member = groups(*keys)
        unique = [_select(operand, first) for operand in operands]
        refused = mixed[first].copy()
        for operand in unique:
            refused |= operand.refused
        if allowed is not None:
            refused |= ~allowed[first]
        result = _empty(first.size, operands[0].dtype)
        good = ~refused
        if good.any():
            _assign(result, good, compute(*(_select(operand, good) for operand in unique)), packed=True)
        for i in np.flatnonzero(refused).tolist():
            bases = np.array([operand.base[i] for operand in unique])
            result.base[i] = self._refuse_combination(bases, bool(mixed[first][i]))
        spread = result.map(lambda field: field[member])
        return Tensor(
            np.where(spread.base == CONSTANT, NO_POINT, point).astype(np.int32),
            spread.base, spread.function, spread.scale, spread.offset, spread.dtype,
        )  # fmt: skip

    def _refuse_combination(self, bases: np.ndarray, mixed: bool) -> int:
        if (bases < CONSTANT).any():
            return self.store.refuse_together(bases)
        if mixed:
            return self.refuse_mixing()
        return self.store.refuse(
            self.report(
                self.node,
                "it joins different functions of the point in a way that is not piecewise linear",
                "if one of them comes from an extra input (a latent code, time), bind that input to constants",
            )
        )

    def refuse_mixing(self) -> int:
        """The base of elements that depend on more than one point."""
        problem = self.report(
            self.node,
            "it combines values of different points, so that the value at a point depends on the rest of the batch",
            "export a network that maps every point on its own; pooling, attention, or convolution over the points "
            "makes no field",
        )
        return self.store.refuse(problem)


def affine(expression: Expression, scale: float, offset: float) -> Expression:
    """``scale * expression + offset``, without operations that do nothing."""
    if expression.op == "constant":
        return constant(scale * expression.value + offset)
    if scale == -1.0:
        expression = apply("negate", expression)
    elif scale != 1.0:
        expression = apply("multiply", constant(scale), expression)
    return expression if offset == 0.0 else apply("add", expression, constant(offset))


def substitute(expression: Expression, inner: Expression) -> Expression:
    """``expression`` with ``inner`` in place of its variable."""
    if inner == T or not expression.arguments:
        return inner if expression == T else expression
    return Expression(expression.op, tuple(substitute(a, inner) for a in expression.arguments), expression.value)


def _jump(expression: Expression) -> str:
    """Why a function is not continuous; empty if it is, as far as `STEP_RANGE` reaches."""
    if isinstance(simplify(expression), KnotTable):
        return ""
    try:
        places = discontinuities(expression, -STEP_RANGE, STEP_RANGE, limit=1)
    except UndefinedFunction as error:
        return str(error)
    return f"it jumps, for example where its argument is {places[0]:.6g}" if places else ""


def _empty(n: int, dtype: np.dtype) -> Tensor:
    return Tensor(
        np.full(n, NO_POINT, np.int32), np.full(n, CONSTANT, np.int64), np.zeros(n, np.int32), np.zeros(n), np.zeros(n), dtype
    )  # fmt: skip


def _copy(x: Tensor) -> Tensor:
    return x.map(lambda field: field.copy())


def _select(x: Tensor, which: np.ndarray) -> Tensor:
    return x.map(lambda field: field[which])


def _stack(x: Tensor, y: Tensor) -> Tensor:
    pairs = zip(
        (x.point, x.base, x.function, x.scale, x.offset), (y.point, y.base, y.function, y.scale, y.offset), strict=True
    )
    return Tensor(*(np.concatenate(pair) for pair in pairs), dtype=x.dtype)


def _assign(target: Tensor, mask: Mask, source: Tensor, *, packed: bool = False) -> None:
    """Overwrite elements of ``target`` at ``mask`` by those of ``source``, which holds only these if ``packed``."""
    for name in ("point", "base", "function", "scale", "offset"):
        values = getattr(source, name)
        getattr(target, name)[mask] = values if packed else values[mask]


def _drop_zero_scales(x: Tensor) -> Tensor:
    """Turn elements that no longer depend on the point into numbers (``x`` is changed)."""
    gone = x.live & (x.scale == 0.0)
    x.base[gone], x.function[gone], x.point[gone] = CONSTANT, IDENTITY, NO_POINT
    return x
