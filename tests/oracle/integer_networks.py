"""Random networks whose weights are -1, 0 and 1: planes coincide, meet in one point or lie in box faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from oracle.random_networks import ACTIVATIONS
from oracle.sketch import Sketch

ARGUMENTS: dict[str, tuple[float, ...]] = {"leaky_relu": (0.5,), "clip": (-0.5, 0.5)}


@dataclass(frozen=True)
class IntegerNetwork:
    """A body with one to three layers of two to four features, all of it drawn from ``seed``; biases are halves."""

    seed: int
    dimension: int = 3

    def __call__(self, sketch: Sketch[Any], x: Any) -> Any:
        rng = np.random.default_rng(self.seed)
        features, n_features = x, self.dimension
        skip = bool(rng.integers(2))
        n_layers = int(rng.integers(1, 4))
        for layer in range(n_layers):
            activation, width = ACTIVATIONS[rng.integers(len(ACTIVATIONS))], int(rng.integers(2, 5))
            n_operands = 2 if activation in ("maximum", "minimum") else 1
            operands = [
                sketch.affine(features, rng.integers(-1, 2, (width, n_features)), rng.integers(-2, 3, width) / 2)
                for _ in range(n_operands)
            ]
            features, n_features = getattr(sketch, activation)(*operands, *ARGUMENTS.get(activation, ())), width
            if skip and layer + 1 < n_layers:
                features, n_features = sketch.concat(features, x), n_features + self.dimension
        return sketch.affine(features, rng.integers(-1, 2, (1, n_features)), [rng.integers(-2, 3) / 2])
