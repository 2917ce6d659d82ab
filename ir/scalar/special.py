"""Elementary functions that NumPy does not have, or not in a stable form."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from mn_onnx.ir.network import Floats

SMALL = 4096


def sigmoid(x: Floats) -> Floats:
    """``1 / (1 + exp(-x))`` with small relative error on both sides."""
    decay = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, decay) / (1.0 + decay)


def softplus(x: Floats) -> Floats:
    """``log(1 + exp(x))`` without overflow."""
    return np.logaddexp(0.0, x)


@functools.cache
def _compiled_erf() -> Callable[[Floats], Floats]:
    # Imported here because compiled code is only worth its start-up time for large arrays.
    from mn_onnx.ir.scalar.compiled import erf as compiled

    return compiled  # type: ignore[no-any-return]


def erf(x: Floats) -> Floats:
    """The error function of the C library (error below one unit in the last place), elementwise."""
    values = np.asarray(x, np.float64)
    if values.size <= SMALL:
        return np.array([math.erf(value) for value in values.ravel().tolist()]).reshape(values.shape)
    return _compiled_erf()(values)


def sech_squared(x: Floats) -> Floats:
    """``1 - tanh(x)**2`` without cancellation."""
    decay = np.exp(-2.0 * np.abs(x))
    return 4.0 * decay / (1.0 + decay) ** 2
