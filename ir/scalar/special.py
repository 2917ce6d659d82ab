"""Elementary functions that NumPy does not have, or not in a stable form."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from types import ModuleType

import numpy as np

from mn_onnx.ir.network import Floats

SMALL = 4096


@functools.cache
def _compiled() -> ModuleType:
    # Imported here because compiled code is only worth its start-up time for large arrays.
    from mn_onnx.ir.scalar import compiled

    return compiled


def sigmoid(x: Floats) -> Floats:
    """``1 / (1 + exp(-x))`` with small relative error on both sides, or an error below 1e-307."""
    if np.size(x) > SMALL:
        large: Floats = _compiled().sigmoid(x)
        return large
    decay = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, decay) / (1.0 + decay)


def softplus(x: Floats) -> Floats:
    """``log(1 + exp(x))`` without overflow, with small relative error or one below 1e-307."""
    if np.size(x) > SMALL:
        large: Floats = _compiled().softplus(x)
        return large
    return np.maximum(x, 0.0) + np.log1p(np.exp(-np.abs(x)))


def _wave(x: Floats, quarters: int, library: Callable[[Floats], Floats]) -> Floats:
    values = np.asarray(x, np.float64)
    if values.size <= SMALL:
        return library(values)
    if not max(-values.min(), values.max()) <= _compiled().LARGEST_ARGUMENT:
        return library(values)
    result: Floats = _compiled().wave(values, quarters)
    return result


def sin(x: Floats) -> Floats:
    """The sine, within 2.1 units in the last place."""
    return _wave(x, 0, np.sin)


def cos(x: Floats) -> Floats:
    """The cosine, within 2.1 units in the last place."""
    return _wave(x, 1, np.cos)


def erf(x: Floats) -> Floats:
    """The error function of the C library (error below one unit in the last place), elementwise."""
    values = np.asarray(x, np.float64)
    if values.size <= SMALL:
        return np.array([math.erf(value) for value in values.ravel().tolist()]).reshape(values.shape)
    result: Floats = _compiled().erf(values)
    return result


def sech_squared(x: Floats) -> Floats:
    """``1 - tanh(x)**2`` without cancellation."""
    decay = np.exp(-2.0 * np.abs(x))
    return 4.0 * decay / (1.0 + decay) ** 2
