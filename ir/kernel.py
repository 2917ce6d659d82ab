"""Numba's decorator with the options that kernels share."""

from __future__ import annotations

from typing import Any

import numba

# No wrapper for callers in C: there are none, and it would be a twentieth of the time of compiling.
_OPTIONS: dict[str, Any] = {"cache": True, "no_cfunc_wrapper": True}

# For kernels that other kernels call: a division by zero gives infinity or NaN.
kernel = numba.njit(error_model="numpy", **_OPTIONS)
# The same, put into its callers before types are inferred, so that each of them can have its own.
inlined_kernel = numba.njit(error_model="numpy", inline="always", **_OPTIONS)
# For kernels that Python calls, by several threads at once, and what they call: a division by zero is an error.
threaded_kernel = numba.njit(nogil=True, **_OPTIONS)
