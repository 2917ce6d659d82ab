"""Compiled elementwise functions."""

from __future__ import annotations

import math

import numba


@numba.vectorize(["float64(float64)"], cache=True)
def erf(x: float) -> float:
    """The error function, by the C library."""
    return math.erf(x)
