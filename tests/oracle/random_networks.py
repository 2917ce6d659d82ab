"""Random tiny networks in general position: bodies for `oracle.sketch`, and units with tables of any kind.

Weights are multiples of 2^-10, so that float32 holds them exactly, with enough bits to make coincidences improbable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from oracle.sketch import Sketch, affine_row, evaluate

ACTIVATIONS = ("relu", "leaky_relu", "abs", "clip", "maximum", "minimum")


@dataclass(frozen=True)
class RandomNetwork:
    """A body with ``len(layers)`` hidden layers; ``layers`` holds (activation, width) each.

    ``skip`` feeds the coordinates to every layer again. ``maximum`` and ``minimum`` take twice their width of features.
    """

    dimension: int
    layers: tuple[tuple[str, int], ...]
    skip: bool
    seed: int
    output_bias: float = 0.0

    def __call__(self, sketch: Sketch[Any], x: Any) -> Any:
        rng = np.random.default_rng(self.seed)
        features, n_features = x, self.dimension
        for index, (activation, width) in enumerate(self.layers):
            features = self._layer(sketch, rng, features, n_features, activation, width)
            n_features = width
            if self.skip and index + 1 < len(self.layers):
                features = sketch.concat(features, x)
                n_features += self.dimension
        return sketch.affine(features, _weights(rng, 1, n_features), self.output_bias)

    def _layer(
        self, sketch: Sketch[Any], rng: np.random.Generator, features: Any, n_features: int, activation: str, width: int
    ) -> Any:
        def dense() -> Any:
            bias = _dyadic(rng.uniform(-0.4, 0.4, width))
            return sketch.affine(features, _weights(rng, width, n_features), bias)

        if activation in ("maximum", "minimum"):
            return getattr(sketch, activation)(dense(), dense())
        arguments = {"leaky_relu": (0.125,), "clip": (-0.25, 0.375)}.get(activation, ())
        return getattr(sketch, activation)(dense(), *arguments)

    def centred(self) -> RandomNetwork:
        """The same network with its level set through the middle of its values in the box [-1, 1]^d.

        Values that repeat do not count, because they come from a region where the network is constant.
        """
        points = np.random.default_rng(0).uniform(-1.0, 1.0, (1024, self.dimension))
        values, counts = np.unique(evaluate(replace(self, output_bias=0.0), points), return_counts=True)
        single = values[counts == 1]
        return replace(self, output_bias=-float(_dyadic(np.median(single)))) if single.size else self


def _weights(rng: np.random.Generator, n_rows: int, n_columns: int) -> NDArray[np.float64]:
    return _dyadic(rng.normal(size=(n_rows, n_columns)) * np.sqrt(2.0 / n_columns))


def _dyadic(values: ArrayLike) -> NDArray[np.float64]:
    return np.round(np.asarray(values) * 1024) / 1024


def random_tables(seed: int, layers: Sequence[int], *, n_knots: int = 3, n_outputs: int = 2) -> Network:
    """A network over three coordinates whose units have up to ``n_knots`` knots and ``n_outputs`` outputs each.

    Every unit reads all coordinates and outputs of earlier layers. The level is in the middle of the values.
    """
    rng = np.random.default_rng(seed)
    units: list[Unit] = []
    n_variables = 3
    for width in layers:
        for _ in range(width):
            row = affine_row(_weights(rng, 1, n_variables)[0], float(_dyadic(rng.uniform(-0.3, 0.3))))
            table = _random_table(rng, int(rng.integers(1, n_knots + 1)), n_outputs)
            units.append(Unit(row, _outputs(table), f"table_{len(units)}", table))
        n_variables += width * n_outputs
    output = affine_row(_weights(rng, 1, n_variables)[0], 0.0)
    values = table_values(Network(3, tuple(units), output), rng.uniform(-1.0, 1.0, (512, 3)))
    return Network(3, tuple(units), replace(output, bias=-float(_dyadic(np.median(values)))))


def table_values(network: Network, points: ArrayLike) -> NDArray[np.float64]:
    """The values [n] of a canonical network at ``points`` [n, dimension], unit by unit."""
    variables = list(np.asarray(points, np.float64).T)

    def row_values(row: AffineRow) -> NDArray[np.float64]:
        terms = (weight * variables[column] for column, weight in zip(row.columns, row.weights, strict=True))
        return np.asarray(sum(terms, np.full_like(variables[0], row.bias)))

    for unit in network.units:
        variables += list(unit.table.evaluate(row_values(unit.row)))
    return row_values(network.output)


def _random_table(rng: np.random.Generator, n_knots: int, n_outputs: int) -> KnotTable:
    """Knots and slopes are multiples of 2^-5, so that the intercepts of a continuous function are exact."""
    knots = np.sort(rng.choice(np.arange(-24, 25), n_knots, replace=False)) / 32
    slopes = np.round(rng.uniform(-1.5, 1.5, (n_outputs, n_knots + 1)) * 32) / 32
    steps = (slopes[:, :-1] - slopes[:, 1:]) * knots
    first = np.round(rng.uniform(-0.5, 0.5, (n_outputs, 1)) * 32) / 32
    intercepts = first + np.concatenate([np.zeros((n_outputs, 1)), np.cumsum(steps, axis=1)], axis=1)
    return KnotTable.exact(knots, slopes, intercepts)


def _outputs(table: KnotTable) -> tuple[KnotTable, ...]:
    return tuple(
        KnotTable.exact(table.knots, table.slopes[k : k + 1], table.intercepts[k : k + 1])
        for k in range(table.n_outputs)
    )
