"""Arithmetic, comparison and choice on symbolic tensors.

Functions of different directions can be added (each nonlinear one becomes a unit), compared (through their difference),
and joined by maximum and minimum. Their product is no affine combination and is refused.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mn_onnx.ir.expression import apply, constant
from mn_onnx.symbolic import CONSTANT, IDENTITY, Tensor, check_size, join
from mn_onnx.symbolic.compose import BOOL, Builder, Composer
from mn_onnx.symbolic.elements import Mask, assign, copy, drop_zero_scales
from mn_onnx.symbolic.store import Rows


class Algebra(Composer):
    """Elementwise operations of two and three tensors."""

    def add(self, x: Tensor, y: Tensor, sign: float = 1.0) -> Tensor:
        """``x + sign * y``."""
        return self._binary(x, y, lambda a, b: self._add(a, b, sign))

    def _add(self, x: Tensor, y: Tensor, sign: float) -> Tensor:
        result = copy(x)
        number_x, number_y = x.base == CONSTANT, y.base == CONSTANT
        result.offset[number_y] += sign * y.offset[number_y]
        only_y = number_x & ~number_y
        assign(result, only_y, y)
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
            assign(result, related, self._add_related(x[related], y[related], sign), packed=True)
        apart = both & ~same & ~related
        if apart.any():
            assign(result, apart, self._add_rows(x[apart], y[apart], sign), packed=True)
        return drop_zero_scales(result)

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
        result = copy(x)
        refused = x.refused | y.refused
        for i in np.flatnonzero(refused).tolist():
            result.base[i] = self.store.refuse_together(np.array([x.base[i], y.base[i]]))
        good = ~refused
        n = int(good.sum())
        stacked = join([x[good], y[good]], np.concatenate)
        rows = self.store.rows(stacked, self.node)
        total = Rows(
            rows.columns, rows.matrix[:n] + sign * rows.matrix[n:], rows.constants[:n] + sign * rows.constants[n:]
        )
        result.base[good], result.function[good], result.scale[good], result.offset[good] = self.store.elements(total)
        return result

    def _absorb_bias(self, result: Tensor, mask: Mask, linear: Tensor) -> Tensor:
        """Make a layer's bias a part of the base, so that activations are functions of the whole pre-activation.

        A bias is what is added to a row that has no constant yet, or a vector of different numbers; a number added to
        all elements alike belongs to the formula of an activation, whose thresholds must stay exact.
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
        result = copy(x)
        number_y = y.base == CONSTANT
        for scaled, factor, mask in ((x, y, number_y), (y, x, (x.base == CONSTANT) & ~number_y)):
            assign(result, mask, scaled)
            result.scale[mask] = scaled.scale[mask] * factor.offset[mask]
            result.offset[mask] = scaled.offset[mask] * factor.offset[mask]
        both = x.live & y.live
        self._compose_or_refuse(result, x, y, both, lambda a, b: apply("multiply", a, b), "a product")
        return drop_zero_scales(result)

    def divide(self, x: Tensor, y: Tensor) -> Tensor:
        """``x / y``."""
        return self._binary(x, y, self._divide)

    def _divide(self, x: Tensor, y: Tensor) -> Tensor:
        result = copy(x)
        by_number = y.base == CONSTANT
        if (y.offset[by_number] == 0.0).any():
            raise ValueError("division by zero")
        result.scale[by_number] = x.scale[by_number] / y.offset[by_number]
        result.offset[by_number] = x.offset[by_number] / y.offset[by_number]
        self._compose_or_refuse(result, x, y, y.live, lambda a, b: apply("divide", a, b), "a quotient")
        return drop_zero_scales(result)

    def _compose_or_refuse(self, result: Tensor, x: Tensor, y: Tensor, mask: Mask, build: Builder, what: str) -> None:
        related = mask & (~x.live | self._related(x, y))
        if related.any():
            assign(result, related, self._compose([x[related], y[related]], build), packed=True)
        apart = mask & ~related
        if apart.any():
            problem = self.report(
                self.node,
                f"{what} of two different functions of the point is not piecewise linear",
                "if one factor comes from an extra input (a latent code, time), bind that input to constants",
            )
            result.base[apart] = self.store.refuse(problem)

    def compare(self, x: Tensor, y: Tensor, operation: str) -> Tensor:
        """Truth of ``less``, ``less_equal`` or ``equal`` for every element."""

        def choose(a: Tensor, b: Tensor) -> Tensor:
            result = self._composed(a, b, operation, lambda excess, _: excess)
            # An element compared with itself, as in tests for NaN.
            equal = (
                a.live & (a.base == b.base) & (a.function == b.function) & (a.scale == b.scale) & (a.offset == b.offset)
            )
            result.base[equal], result.function[equal] = CONSTANT, IDENTITY
            result.scale[equal], result.offset[equal] = 0.0, float(operation != "less")
            return result

        return self._binary(x, y, choose).with_dtype(BOOL)

    def extremum(self, x: Tensor, y: Tensor, operation: str) -> Tensor:
        """``maximum`` or ``minimum`` of two tensors."""

        def above(excess: Tensor, y: Tensor) -> Tensor:
            return self._elementwise([excess, y], lambda p, q: self._add(p, q, 1.0))

        return self._binary(x, y, lambda a, b: self._composed(a, b, operation, above))

    def _composed(self, x: Tensor, y: Tensor, operation: str, apart: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """``operation(x, y)`` where both are functions of one direction.

        Elsewhere it is what ``apart`` makes of ``operation(x - y, 0)`` and ``y``.
        """
        related = ~(x.live & y.live) | self._related(x, y)
        result = copy(x)
        direct = self._compose([x[related], y[related]], lambda p, q: apply(operation, p, q))
        assign(result, related, direct, packed=True)
        if not related.all():
            left, right = x[~related], y[~related]
            excess = self._elementwise(
                [self._add_rows(left, right, -1.0)],
                lambda d: self._compose([d], lambda p: apply(operation, p, constant(0.0))),
            )
            assign(result, ~related, apart(excess, right), packed=True)
        return result

    def where(self, condition: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """``x`` where ``condition`` holds, else ``y``."""
        shape = np.broadcast_shapes(condition.shape, x.shape, y.shape)
        check_size(shape)
        c, a, b = (self._cut_large(part).broadcast(shape).reshape(-1) for part in (condition, x, y))
        known = c.base == CONSTANT
        result = copy(b)
        assign(result, known & (c.offset != 0.0), a)
        open_ = ~known
        if open_.any():
            c, a, b = c[open_], a[open_], b[open_]
            related = (~a.live | self._related(c, a)) & (~b.live | self._related(c, b)) & c.live
            chosen = copy(b)
            assign(chosen, related, self._choose(*(p[related] for p in (c, a, b))), packed=True)
            if not related.all():
                c, a, b = (p[~related] for p in (c, a, b))
                difference = self.add(a, b, -1.0)
                gain = self.apply([c, difference], lambda t, d: apply("where", t, d, constant(0.0)), x.dtype)
                assign(chosen, ~related, self.add(b, gain), packed=True)
            assign(result, open_, chosen, packed=True)
        return result.reshape(*shape).with_dtype(x.dtype)

    def _choose(self, c: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return self._elementwise(
            [c, a, b],
            lambda *parts: self._compose(list(parts), lambda t, p, q: apply("where", t, p, q)),
        )
