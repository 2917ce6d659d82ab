"""Largest entries of an array over many ranges at once."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.network import Floats, Integers


class RangeMaximum:
    """The largest of ``values[first : last + 1]`` for arrays of ranges, by a sparse table: constant time for each."""

    def __init__(self, values: Floats) -> None:
        rows = [values]
        span = 1
        while 2 * span <= values.size:
            previous = rows[-1]
            rows.append(np.maximum(previous[: values.size - 2 * span + 1], previous[span : values.size - span + 1]))
            span *= 2
        self._rows = np.full((len(rows), values.size), -np.inf)
        for row, entries in zip(self._rows, rows, strict=True):
            row[: entries.size] = entries

    def __call__(self, first: Integers, last: Integers) -> Floats:
        """Maxima over ``first <= i <= last``, in their shape; -inf for an empty range."""
        length = last - first + 1
        level = np.maximum(np.frexp(np.maximum(length, 1))[1] - 1, 0)
        right = np.maximum(last - (1 << level) + 1, 0)
        largest = np.maximum(self._rows[level, np.minimum(first, self._rows.shape[1] - 1)], self._rows[level, right])
        return np.where(length > 0, largest, -np.inf)
