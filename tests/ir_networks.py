"""Random networks for the tests of the IR, and their evaluation unit by unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from mn_onnx.ir.expression import Expression, T, apply, constant
from mn_onnx.ir.network import AffineRow, Floats, KnotTable, Network, ScalarFunction, Unit
from mn_onnx.ir.scalar import evaluate as evaluate_scalar

RELU = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.0]])
LEAKY = KnotTable.exact([0.0], [[0.1, 1.0]], [[0.0, 0.0]])
CLIP = KnotTable.exact([-0.5, 0.5], [[0.0, 1.0, 0.0]], [[-0.5, 0.0, 0.5]])
STAIRS = KnotTable.exact([-1.0, 0.0, 0.25, 1.0], [[1.0, -0.5, 2.0, 0.0, 1.0]], [[1.5, 0.0, 0.0, 0.5, -0.5]])
AFFINE = KnotTable.exact([], [[-1.5]], [[0.25]])
RELU_EXPRESSION = apply("maximum", T, constant(0.0))
SILU = apply("multiply", T, apply("sigmoid", T))
TANH = apply("tanh", T)
SINE = apply("sin", apply("multiply", constant(6.0), T))
ELU = apply("where", apply("less", constant(0.0), T), T, apply("subtract", apply("exp", T), constant(1.0)))

PIECEWISE_LINEAR: tuple[ScalarFunction, ...] = (RELU, LEAKY, CLIP, STAIRS, AFFINE, RELU_EXPRESSION)
SMOOTH: tuple[ScalarFunction, ...] = (SILU, TANH, SINE, ELU)


def softplus(beta: float) -> Expression:
    return apply("divide", apply("softplus", apply("multiply", constant(beta), T)), constant(beta))


def dense(sizes: list[int], function: ScalarFunction = RELU, *, seed: int = 0, dimension: int = 3) -> Network:
    """A fully connected network with one function everywhere, its values of order one."""
    rng = np.random.default_rng(seed)
    below, units = np.arange(dimension), []
    for layer, size in enumerate(sizes):
        weights = rng.normal(size=(size, below.size)) / np.sqrt(below.size)
        for unit in range(size):
            row = AffineRow(below, weights[unit], float(rng.normal() * 0.2))
            units.append(Unit(row, (function,), f"layer{layer}[{unit}]"))
        below = np.arange(dimension + len(units) - size, dimension + len(units))
    output = AffineRow(below, rng.normal(size=below.size) / np.sqrt(below.size), 0.05)
    return Network(dimension, tuple(units), output)


def with_flat_units(layers: list[int], seed: int) -> Network:
    """Dense layers of ReLU; every third unit's output is divided by 4,096, and the weights on it are multiplied."""
    network = dense(layers, seed=seed)
    flat = KnotTable.exact([0.0], [[0.0, 2.0**-12]], [[0.0, 0.0]])

    def scaled(row: AffineRow) -> AffineRow:
        is_flat = (row.columns >= 3) & (row.columns % 3 == 0)
        return replace(row, weights=np.where(is_flat, 2.0**12, 1.0) * row.weights)

    units = [
        replace(unit, row=scaled(unit.row), functions=(flat,) if g % 3 == 0 else unit.functions)
        for g, unit in enumerate(network.units)
    ]
    return Network(3, tuple(units), scaled(network.output))


@st.composite
def networks(draw: st.DrawFn, functions: tuple[ScalarFunction, ...] = PIECEWISE_LINEAR) -> Network:
    """Small networks with skips, repeated, opposite, scaled and constant rows, unused and many-output units."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    dimension = draw(st.integers(1, 3))
    units: list[Unit] = []
    n_variables = dimension
    for layer in range(draw(st.integers(1, 3))):
        readable = n_variables
        rows: list[AffineRow] = []
        for index in range(draw(st.integers(1, 4))):
            kind = draw(st.sampled_from(["new", "new", "new", "scaled", "shifted", "same", "constant"]))
            row = AffineRow(np.zeros(0, np.int64), np.zeros(0), float(rng.normal()))
            if kind != "constant":
                columns = np.flatnonzero(rng.random(readable) < 0.7)
                row = AffineRow(columns, rng.normal(size=columns.size), float(rng.normal() * 0.3))
            if rows and kind in ("scaled", "shifted", "same"):
                other = rows[int(rng.integers(len(rows)))]
                scale = {"scaled": float(rng.choice([-3.0, 0.3, np.pi])), "shifted": 1.0, "same": 1.0}[kind]
                bias = scale * other.bias + (0.7 if kind == "shifted" else 0.0)
                row = AffineRow(other.columns, scale * other.weights, bias)
            rows.append(row)
            chosen = tuple(draw(st.lists(st.sampled_from(functions), min_size=1, max_size=2)))
            units.append(Unit(row, chosen, f"layer{layer}[{index}]"))
        n_variables += sum(unit.n_outputs for unit in units[-len(rows) :])
    columns = np.flatnonzero(rng.random(n_variables) < 0.6)
    output = AffineRow(columns, rng.normal(size=columns.size), float(rng.normal() * 0.1))
    return Network(dimension, tuple(units), output)


def scalar_values(function: ScalarFunction, t: Floats) -> Floats:
    return function.evaluate(t)[0] if isinstance(function, KnotTable) else evaluate_scalar(function, t)


def naive_values(network: Network, points: Floats, *, tables: bool = False) -> Floats:
    """``f`` at ``points``, one unit after the other: by true functions, or by ``tables`` where there are any."""
    variables = [points[:, axis] for axis in range(network.input_dim)]

    def row_values(row: AffineRow) -> Floats:
        total = np.full(points.shape[0], row.bias)
        for column, weight in zip(row.columns, row.weights, strict=True):
            total = total + weight * variables[column]
        return total

    for unit in network.units:
        t = row_values(unit.row)
        if tables and unit.table is not None:
            variables.extend(unit.table.evaluate(t))
        else:
            variables.extend(scalar_values(function, t) for function in unit.functions)
    return row_values(network.output)


def random_points(network: Network, count: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).uniform(-1, 1, (count, network.input_dim))


def unit_box(network: Network) -> tuple[Floats, Floats]:
    return -np.ones(network.input_dim), np.ones(network.input_dim)
