"""Compiled elementwise functions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]

# pi / 2 in three parts (Cody and Waite, Software Manual for the Elementary Functions, chapter 8): the first two have 33
# bits, so that their multiples by an integer below 2**20 are exact.
QUARTER = tuple(float.fromhex(part) for part in ("0x1.921fb544p+0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69"))
LARGEST_ARGUMENT = 2.0**20

# Taylor's series; on [-pi/4, pi/4] the first term left out is below 2**-60.
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(9))
COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(9))

# Of the exponential on [-log(2)/2, log(2)/2], and of 2 artanh(s) / s on [0, 1/3]: below 2**-57 and 2**-59.
EXPONENTIAL = tuple(1 / math.factorial(k) for k in range(14))
ARTANH = tuple(2 / (2 * k + 1) for k in range(18))
LOG2_E = 1 / math.log(2)
# log(2) in two parts (Cody and Waite, chapter 6): the first has 33 bits.
LOG_2 = (float.fromhex("0x1.62e42fee00000p-1"), float.fromhex("0x1.a39ef35793c76p-33"))
DEEPEST = -708.0
"""Below this the exponential underflows."""

# Added to a number of this size, a double is rounded to an integer, which its low bits then spell out.
ROUNDER = 1.5 * 2.0**52
BIAS = 1023
FRACTION_BITS = 52


@numba.vectorize(["float64(float64)"], cache=True)
def erf(x: float) -> float:
    """The error function, by the C library."""
    return math.erf(x)


@threaded_kernel
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


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _decay(x: float) -> float:
    """``exp(x)`` of ``x`` at most 0, or ``exp(DEEPEST)`` below that."""
    x = DEEPEST if x < DEEPEST else x
    shifted = x * LOG2_E + ROUNDER
    power = shifted - ROUNDER
    r = (x - power * LOG_2[0]) - power * LOG_2[1]
    e = EXPONENTIAL[9] + r * (EXPONENTIAL[10] + r * (EXPONENTIAL[11] + r * (EXPONENTIAL[12] + r * EXPONENTIAL[13])))
    e = EXPONENTIAL[5] + r * (EXPONENTIAL[6] + r * (EXPONENTIAL[7] + r * (EXPONENTIAL[8] + r * e)))
    e = 1.0 + r * (1.0 + r * (EXPONENTIAL[2] + r * (EXPONENTIAL[3] + r * (EXPONENTIAL[4] + r * e))))
    exponent = (np.float64(shifted).view(np.int64) + BIAS) << FRACTION_BITS
    return e * np.int64(exponent).view(np.float64)


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _log_one_plus(y: float) -> float:
    """``log(1 + y)`` of ``y`` in [0, 1]: twice the area tangent of y / (2 + y)."""
    s = y / (2.0 + y)
    z = s * s
    a = ARTANH[12] + z * (ARTANH[13] + z * (ARTANH[14] + z * (ARTANH[15] + z * (ARTANH[16] + z * ARTANH[17]))))
    a = ARTANH[7] + z * (ARTANH[8] + z * (ARTANH[9] + z * (ARTANH[10] + z * (ARTANH[11] + z * a))))
    a = ARTANH[2] + z * (ARTANH[3] + z * (ARTANH[4] + z * (ARTANH[5] + z * (ARTANH[6] + z * a))))
    return s * (2.0 + z * (ARTANH[1] + z * a))


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _softplus(x: Floats, result: Floats) -> None:
    for i in range(x.size):
        result[i] = _log_one_plus(_decay(-abs(x[i]))) + (x[i] if x[i] > 0.0 else 0.0)


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _sigmoid(x: Floats, result: Floats) -> None:
    for i in range(x.size):
        decay = _decay(-abs(x[i]))
        result[i] = (1.0 if x[i] >= 0.0 else decay) / (1.0 + decay)


def _elementwise(kernel: Callable[..., None], x: Floats, *parameters: float) -> Floats:
    flat = np.ascontiguousarray(x, np.float64).reshape(-1)
    result = np.empty_like(flat)
    kernel(flat, *parameters, result)
    return result.reshape(np.shape(x))


def wave(x: Floats, quarters: int) -> Floats:
    """``sin(x + quarters * pi / 2)`` at ``x`` (|x| at most `LARGEST_ARGUMENT`), within 2.1 units in the last place."""
    return _elementwise(_wave, x, float(quarters))


def softplus(x: Floats) -> Floats:
    """``log(1 + exp(x))``, within 3 units in the last place, or 1e-307."""
    return _elementwise(_softplus, x)


def sigmoid(x: Floats) -> Floats:
    """``1 / (1 + exp(-x))``, within 2.1 units in the last place, or 1e-307."""
    return _elementwise(_sigmoid, x)
