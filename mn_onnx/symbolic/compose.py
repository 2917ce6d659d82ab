"""Composition of symbolic elements: functions of one direction become one scalar expression."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mn_onnx.ir.expression import Expression, T, constant
from mn_onnx.ir.network import KnotTable
from mn_onnx.ir.scalar import UndefinedFunction, discontinuities, evaluate, simplify
from mn_onnx.symbolic import CONSTANT, IDENTITY, NO_POINT, Array, Tensor, check_size, groups
from mn_onnx.symbolic.elements import Mask, affine, assign, copy, empty, substitute
from mn_onnx.symbolic.store import Store

Builder = Callable[..., Expression]

BOOL = np.dtype(bool)
STEP_RANGE = 64.0
"""Jumps of a function are looked for on ``[-STEP_RANGE, STEP_RANGE]``; further out the range of its unit decides."""


class Composer:
    """Elementwise functions over one `Store`.

    ``report(node, reason, remedy)`` records a problem and returns its number; ``node`` is the label of the node being
    lowered, or of the one to blame. Operands are broadcast; results have their common shape.
    """

    def __init__(self, store: Store, report: Callable[[str, str, str], int]) -> None:
        self.store = store
        self.report = report
        self.node = ""
        self._step_refusals: dict[int, int | None] = {}

    def unary(self, x: Tensor, build: Builder) -> Tensor:
        """``build`` applied to every element."""
        return self.apply([x], build)

    def apply(self, operands: Sequence[Tensor], build: Builder, dtype: np.dtype | None = None) -> Tensor:
        """``build`` of elements that depend on the point through one direction at most; else refused."""
        shape = np.broadcast_shapes(*(operand.shape for operand in operands))
        check_size(shape)
        flat = [self._cut_large(operand).broadcast(shape).reshape(-1) for operand in operands]
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
                function[members] = self.store.function(expression, self._to_blame(operands, position))
                scale[members] = 1.0
        return Tensor(np.full(n, NO_POINT, np.int32), base, function, scale, offset, operands[0].dtype)

    def _to_blame(self, operands: Sequence[Tensor], i: int) -> str:
        """The node that would make a composition jump: the one that made a part jump, else the present one."""
        parts = [self.store.step_nodes[operand.function[i]] for operand in operands if operand.live[i]]
        return next(filter(None, parts), self.node)

    def _expression(self, operand: Tensor, i: int, relation: tuple[np.ndarray, np.ndarray]) -> Expression:
        if not operand.live[i]:
            return constant(float(operand.offset[i]))
        inner = affine(T, float(relation[0][i]), float(relation[1][i]))
        outer = substitute(self.store.functions[operand.function[i]], inner)
        return affine(outer, float(operand.scale[i]), float(operand.offset[i]))

    def _cut_large(self, x: Tensor) -> Tensor:
        """Make units of functions that have grown too long to be composed further.

        This must come before operands are compared, as it changes the direction of an element.
        """
        functions = np.unique(x.function[x.live])
        large = (
            functions[[self.store.is_large(number) for number in functions.tolist()]] if functions.size else functions
        )
        # Truth values cannot be units; they only grow by logic.
        if not large.size or x.dtype == BOOL:
            return x
        result = copy(self.settle(x))
        for i in np.flatnonzero(result.live & np.isin(result.function, large)).tolist():
            variable = self.store.unit(int(x.base.flat[i]), int(x.function.flat[i]), self.node)
            result.base.flat[i], result.function.flat[i] = self.store.variable_base(variable), IDENTITY
        return result

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
            "export the field before it is rounded, quantised, thresholded or classified; where a comparison only "
            "guards a quotient such as sin(t)/t, export sin(s)/s with s = sqrt(t*t + 1e-8) instead",
        )
        return self.store.refuse(problem)

    def _related(self, x: Tensor, y: Tensor) -> Mask:
        """Where both are live and functions of the same direction."""
        both = x.live & y.live
        related: Mask = both & (x.base == y.base)
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
        flat = [self._cut_large(operand).broadcast(shape).reshape(-1) for operand in (x, y)]
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
            of_a_point = operand.live & (operand.point != NO_POINT)
            mixed |= (point != NO_POINT) & of_a_point & (operand.point != point)
            point = np.where(of_a_point, operand.point, point)
        keys: list[Array] = [mixed]
        for operand in operands:
            keys += [operand.base, operand.function, operand.scale, operand.offset]
        first, member = groups(*keys)
        unique = [operand[first] for operand in operands]
        refused = mixed[first].copy()
        for operand in unique:
            refused |= operand.refused
        if allowed is not None:
            refused |= ~allowed[first]
        result = empty(first.size, operands[0].dtype)
        good = ~refused
        if good.any():
            assign(result, good, compute(*(operand[good] for operand in unique)), packed=True)
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


def _jump(expression: Expression) -> str:
    """Why a function is not continuous; empty if it is, as far as `STEP_RANGE` reaches."""
    if isinstance(simplify(expression), KnotTable):
        return ""
    try:
        places = discontinuities(expression, -STEP_RANGE, STEP_RANGE, limit=1)
    except UndefinedFunction as error:
        return str(error)
    return f"it jumps, for example where its argument is {places[0]:.6g}" if places else ""
