"""The entries that symbolic elements refer to: directions, bases, functions, units, and reasons for refusal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.expression import Expression, T
from mn_onnx.symbolic import CONSTANT, IDENTITY, Tensor

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

STEPS = frozenset({"sign", "floor", "ceil", "round", "less", "less_equal", "equal"})
EXPRESSION_LIMIT = 128
"""Most operations of one scalar function; larger ones are cut by making the inner function a unit of its own."""


@dataclass(frozen=True)
class Base:
    """A pre-activation ``scale * direction . v + shift``."""

    direction: int
    scale: float
    shift: float


@dataclass(frozen=True, eq=False)
class Rows:
    """Affine rows ``matrix @ v[columns] + constants``: int64 [c] increasing, float64 [n, c], float64 [n]."""

    columns: Integers
    matrix: Floats
    constants: Floats

    def combined(self, weights: Floats, bias: Floats | float = 0.0) -> Rows:
        """``weights`` [m, n] times these rows, plus ``bias`` in the constants."""
        constants = weights @ self.constants + bias
        counts = np.count_nonzero(self.matrix, axis=1)
        columns = np.abs(self.matrix).argmax(axis=1) if self.matrix.size else np.zeros(0, np.int64)
        if (counts == 1).all() and np.unique(columns).size == len(counts) == self.columns.size:
            # The usual case behind a layer of activations: every row is one variable of its own.
            matrix = np.empty((len(weights), len(counts)))
            matrix[:, columns] = weights * self.matrix[np.arange(len(counts)), columns]
        else:
            matrix = weights @ self.matrix
        return Rows(self.columns, matrix, constants)


class Store:
    """Directions, bases, functions and units of one import, each stored once.

    A *direction* is a row without constant, normalised by a signed power of two, which loses nothing: rows that differ
    by such a factor or in their constant are found to be functions of each other.
    """

    def __init__(self, input_dim: int) -> None:
        self.input_dim = input_dim
        self.functions: list[Expression] = [T]
        self._function_ids = {T: IDENTITY}
        self._sizes = [1]
        self.step_nodes: list[str] = [""]
        self.directions: list[tuple[Integers, Floats]] = []
        self._direction_ids: dict[tuple[bytes, bytes], int] = {}
        self.bases: list[Base] = []
        self._base_ids: dict[Base, int] = {}
        self.units: list[tuple[int, int]] = []
        self._variables: dict[tuple[int, int], int] = {}
        self.names: dict[tuple[int, int], str] = {}
        self._refusals: list[frozenset[int]] = []
        self._refusal_ids: dict[frozenset[int], int] = {}
        for coordinate in range(input_dim):
            self.variable_base(coordinate)

    # Functions

    def function(self, expression: Expression, node: str) -> int:
        """The number of a function; ``node`` is to blame if it jumps."""
        known = self._function_ids.get(expression)
        if known is not None:
            return known
        number = len(self.functions)
        self._function_ids[expression] = number
        self.functions.append(expression)
        operations = list(_operations(expression))
        self._sizes.append(len(operations))
        self.step_nodes.append(node if STEPS.intersection(operations) else "")
        return number

    def is_large(self, function: int) -> bool:
        return self._sizes[function] > EXPRESSION_LIMIT

    # Directions and bases

    def variable_base(self, variable: int) -> int:
        """The base that is one variable itself."""
        direction = self._direction(np.array([variable], np.int64), np.ones(1))
        return self.base(direction, 1.0, 0.0)

    def base(self, direction: int, scale: float, shift: float) -> int:
        entry = Base(direction, scale, shift + 0.0)
        number = self._base_ids.setdefault(entry, len(self.bases))
        if number == len(self.bases):
            self.bases.append(entry)
        return number

    def _direction(self, columns: Integers, weights: Floats) -> int:
        key = (columns.tobytes(), weights.tobytes())
        number = self._direction_ids.setdefault(key, len(self.directions))
        if number == len(self.directions):
            self.directions.append((columns, weights))
        return number

    def base_fields(self, bases: Integers) -> tuple[Integers, Floats, Floats]:
        """Direction, scale and shift [n] of bases [n]."""
        entries = [self.bases[number] for number in bases.tolist()]
        return (
            np.array([entry.direction for entry in entries], np.int64),
            np.array([entry.scale for entry in entries], np.float64),
            np.array([entry.shift for entry in entries], np.float64),
        )

    # Units

    def unit(self, base: int, function: int, fallback_name: str) -> int:
        """The variable that holds ``function`` of ``base``; the unit is made on first use."""
        key = (base, function)
        variable = self._variables.setdefault(key, self.input_dim + len(self.units))
        if variable == self.input_dim + len(self.units):
            self.units.append(key)
            self.names.setdefault(key, f"{fallback_name}[{variable - self.input_dim}]")
        return variable

    def name_elements(self, tensor: Tensor, node: str) -> None:
        """Call units that may come of the elements after ``node`` and their place among the elements of their point."""
        nonlinear = (tensor.live & (tensor.function != IDENTITY)).reshape(-1)
        if not nonlinear.any():
            return
        point = tensor.point.reshape(-1)
        # The first point stands for all: the functions of the others are the same, unless the model is refused.
        mine = np.flatnonzero(point == point[nonlinear.argmax()])
        base, function = tensor.base.reshape(-1)[mine].tolist(), tensor.function.reshape(-1)[mine].tolist()
        for place, key in enumerate(zip(base, function, strict=True)):
            if nonlinear[mine[place]]:
                self.names.setdefault(key, f"{node}[{place}]")

    # Rows

    def rows(self, tensor: Tensor, fallback_name: str) -> Rows:
        """The rows of elements [n] that are linear, numbers, or continuous functions (which become units)."""
        n = tensor.size
        constants = tensor.offset.copy()
        parts: list[tuple[Integers, Floats]] = [(np.zeros(0, np.int64), np.zeros(0))] * n
        bases, functions, scales = tensor.base.tolist(), tensor.function.tolist(), tensor.scale.tolist()
        for i in range(n):
            if bases[i] == CONSTANT:
                continue
            if functions[i] == IDENTITY:
                base = self.bases[bases[i]]
                columns, weights = self.directions[base.direction]
                parts[i] = (columns, weights * (base.scale * scales[i]))
                constants[i] += scales[i] * base.shift
            else:
                variable = self.unit(bases[i], functions[i], fallback_name)
                parts[i] = (np.array([variable], np.int64), np.array([scales[i]]))
        used = np.unique(np.concatenate([columns for columns, _ in parts])) if n else np.zeros(0, np.int64)
        matrix = np.zeros((n, used.size))
        for i, (columns, weights) in enumerate(parts):
            matrix[i, np.searchsorted(used, columns)] = weights
        return Rows(used, matrix, constants)

    def elements(self, rows: Rows) -> tuple[Integers, Integers, Floats, Floats]:
        """Base, function, scale and offset [n] of rows, in the simplest form: a number, one variable, or a new base.

        Raises `ValueError` if a weight or constant is not finite.
        """
        n = len(rows.constants)
        if not (np.isfinite(rows.matrix).all() and np.isfinite(rows.constants).all()):
            raise ValueError("a weight is not a finite number (NaN or infinity)")
        base, function = np.full(n, CONSTANT, np.int64), np.zeros(n, np.int64)
        scale, offset = np.zeros(n), rows.constants.copy()
        present = rows.matrix != 0.0
        counts = present.sum(axis=1)
        exponents = np.frexp(np.abs(rows.matrix).max(axis=1, initial=0.0))[1]
        for i in np.flatnonzero(counts).tolist():
            nonzero = np.flatnonzero(present[i])
            columns, weights = rows.columns[nonzero], rows.matrix[i, nonzero]
            if nonzero.size == 1:
                base[i], function[i] = self._origin(int(columns[0]))
                scale[i] = weights[0]
            else:
                factor = np.copysign(np.ldexp(1.0, int(exponents[i])), weights[0])
                direction = self._direction(columns, weights / factor)
                base[i] = self.base(direction, float(factor), float(offset[i]))
                scale[i], offset[i] = 1.0, 0.0
        return base, function, scale, offset

    def _origin(self, variable: int) -> tuple[int, int]:
        if variable < self.input_dim:
            return variable, IDENTITY
        base, function = self.units[variable - self.input_dim]
        return (self.variable_base(variable), IDENTITY) if self.is_large(function) else (base, function)

    def agrees(self, other: Store, size: tuple[int, int, int, int]) -> bool:
        """Whether the first entries of both stores, counted by `size`, are the same."""
        directions, bases, functions, units = size
        mine, theirs = list(self._direction_ids)[:directions], list(other._direction_ids)[:directions]
        return (
            mine == theirs
            and self.bases[:bases] == other.bases[:bases]
            and self.functions[:functions] == other.functions[:functions]
            and self.units[:units] == other.units[:units]
        )

    def size(self) -> tuple[int, int, int, int]:
        """How many directions, bases, functions and units there are."""
        return len(self.directions), len(self.bases), len(self.functions), len(self.units)

    # Refusals

    def refuse(self, problem: int) -> int:
        """The base of elements that cannot be represented because of problem number ``problem``."""
        return self._refusal(frozenset({problem}))

    def refuse_together(self, bases: Integers) -> int:
        """The base of an element made of several, of which the refused ones decide."""
        found = [self._refusals[-2 - base] for base in bases.tolist() if base < CONSTANT]
        return self._refusal(frozenset().union(*found))

    def refusal_problems(self, base: int) -> frozenset[int]:
        """The problems behind a refused base."""
        return self._refusals[-2 - base]

    def _refusal(self, problems: frozenset[int]) -> int:
        number = self._refusal_ids.setdefault(problems, len(self._refusals))
        if number == len(self._refusals):
            self._refusals.append(problems)
        return -2 - number

    def reject_steps(self, tensor: Tensor, refuse: Callable[[int], int | None]) -> Tensor:
        """Replace elements whose function is refused by ``refuse`` (function number to base, None if it is fine)."""
        nonlinear = tensor.live & (tensor.function != IDENTITY)
        replacements = {
            number: replacement
            for number in np.unique(tensor.function[nonlinear]).tolist()
            if (replacement := refuse(number)) is not None
        }
        if not replacements:
            return tensor
        base = tensor.base.copy()
        for number, replacement in replacements.items():
            base[nonlinear & (tensor.function == number)] = replacement
        return Tensor(tensor.point, base, tensor.function, tensor.scale, tensor.offset, tensor.dtype)


def _operations(expression: Expression) -> Iterator[str]:
    yield expression.op
    for argument in expression.arguments:
        yield from _operations(argument)
