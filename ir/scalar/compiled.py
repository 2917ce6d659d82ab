"""Compiled elementwise functions."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# pi / 2 in three parts (Cody and Waite, Software Manual for the Elementary Functions, chapter 8): the first two have 33
# bits, so that their multiples by an integer below 2**20 are exact.
QUARTER = tuple(float.fromhex(part) for part in ("0x1.921fb544p+0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69"))
LARGEST_ARGUMENT = 2.0**20

# Taylor's series; on [-pi/4, pi/4] the first term left out is below 2**-60.
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(9))
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(9))


@numba.vectorize(["float64(float64)"], cache=True)
def erf(x: float) -> float:
    """The error function, by the C library."""
    return math.erf(x)


@numba.njit(cache=True, nogil=True)
def _wave(x: Floats, quarters: float, result: Floats) -> None:
    """``sin(x + quarters * pi / 2)``, [n]. Without branches, so that the loop runs in vector registers."""
    for i in range(x.size):
        turns = np.floor(x[i] / QUARTER[0] + 0.5)
        r = ((x[i] - turns * QUARTER[0]) - turns * QUARTER[1]) - turns * QUARTER[2]
        quarter = turns + quarters
        half = np.floor(0.5 * quarter)
        odd = quarter - 2.0 * half
        sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))
        z = r * r
        sine = SINE[5] + z * (SINE[6] + z * (SINE[7] + z * SINE[8]))
        sine = r + r * z * (SINE[1] + z * (SINE[2] + z * (SINE[3] + z * (SINE[4] + z * sine))))
        cosine = COSINE[5] + z * (COSINE[6] + z * (COSINE[7] + z * COSINE[8]))
        cosine = 1.0 + z * (COSINE[1] + z * (COSINE[2] + z * (COSINE[3] + z * (COSINE[4] + z * cosine))))
        result[i] = sign * (odd * cosine + (1.0 - odd) * sine)


def wave(x: Floats, quarters: int) -> Floats:
    """``sin(x + quarters * pi / 2)`` at ``x`` (|x| at most `LARGEST_ARGUMENT`), within 2.1 units in the last place."""
    flat = np.ascontiguousarray(x, np.float64).reshape(-1)
    result = np.empty_like(flat)
    _wave(flat, float(quarters), result)
    return result.reshape(np.shape(x))
