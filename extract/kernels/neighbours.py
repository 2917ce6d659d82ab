"""An order of points in which those that follow one another are close to one another, at every scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

DEEPEST = 128


@threaded_kernel
def order_by_halves(points: Floats, order: Integers) -> None:
    """Sort the point numbers ``order`` (int64 [n], of ``points`` float64 [m, d]) as the leaves of a k-d tree.

    A part of n points is divided across its longest side (Bentley, "Multidimensional binary search trees used for
    associative searching", 1975), the first half being the largest power of two below n: so each run of ``2**k`` points
    from a multiple of ``2**k`` on is a part.
    """
    stack = np.empty((DEEPEST, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, order.size
    depth = 1
    while depth:
        depth -= 1
        begin, end = stack[depth]
        if end - begin < 2:
            continue
        half = 1
        while 2 * half < end - begin:
            half *= 2
        _select(points, order, begin, end - 1, begin + half, _longest_side(points, order, begin, end))
        stack[depth, 0], stack[depth, 1] = begin, begin + half
        stack[depth + 1, 0], stack[depth + 1, 1] = begin + half, end
        depth += 2


@threaded_kernel
def _longest_side(points: Floats, order: Integers, begin: int, end: int) -> int:
    longest, length = 0, -1.0
    for axis in range(points.shape[1]):
        low = high = points[order[begin], axis]
        for k in range(begin + 1, end):
            low, high = min(low, points[order[k], axis]), max(high, points[order[k], axis])
        if high - low > length:
            longest, length = axis, high - low
    return longest


@threaded_kernel
def _select(points: Floats, order: Integers, low: int, high: int, rank: int, axis: int) -> None:
    """Move points ``low`` .. ``high`` until none before ``rank`` is above one after it (Hoare, "Find", 1961)."""
    while low < high:
        pivot = points[order[(low + high) >> 1], axis]
        i, j = low, high
        while i <= j:
            while points[order[i], axis] < pivot:
                i += 1
            while points[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            return
