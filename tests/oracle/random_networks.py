"""Random tiny networks in general position, as bodies for `oracle.sketch`.

Weights are multiples of 2^-10, so that float32 holds them exactly, with enough bits to make coincidences improbable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oracle.sketch import Sketch, evaluate

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
        return sketch.affine(features, self._weights(rng, 1, n_features), self.output_bias)

    def _layer(
        self, sketch: Sketch[Any], rng: np.random.Generator, features: Any, n_features: int, activation: str, width: int
    ) -> Any:
        def dense() -> Any:
            bias = _dyadic(rng.uniform(-0.4, 0.4, width))
            return sketch.affine(features, self._weights(rng, width, n_features), bias)

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

    @staticmethod
    def _weights(rng: np.random.Generator, n_rows: int, n_columns: int) -> NDArray[np.float64]:
        return _dyadic(rng.normal(size=(n_rows, n_columns)) * np.sqrt(2.0 / n_columns))


def _dyadic(values: ArrayLike) -> NDArray[np.float64]:
    return np.round(np.asarray(values) * 1024) / 1024
