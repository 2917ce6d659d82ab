"""Largest and smallest entries of a table over many ranges of intervals at once."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.network import Floats, Integers, KnotTable


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


class OutputRanges:
    """What one output of a table does over ranges of its argument: slopes, values and errors."""

    def __init__(self, table: KnotTable, output: int) -> None:
        self.knots = table.knots
        self.slope, self.intercept = table.slopes[output], table.intercepts[output]
        self._steepest, self._flattest = RangeMaximum(self.slope), RangeMaximum(-self.slope)
        self._error = RangeMaximum(table.errors[output]) if table.errors[output].any() else None
        at_knots = self.slope[1:] * table.knots + self.intercept[1:]
        if table.knots.size:
            self._highest, self._lowest = RangeMaximum(at_knots), RangeMaximum(-at_knots)

    def intervals(self, t: Floats) -> Integers:
        """The interval of each argument."""
        return np.searchsorted(self.knots, t, side="right")

    def value(self, t: Floats, interval: Integers) -> Floats:
        """The output at ``t``, which lies in ``interval``."""
        result: Floats = self.slope[interval] * t + self.intercept[interval]
        return result

    def slopes(self, first: Integers, last: Integers) -> tuple[Floats, Floats]:
        """The smallest and largest slope on the intervals ``first``..``last``."""
        return -self._flattest(first, last), self._steepest(first, last)

    def errors(self, first: Integers, last: Integers) -> Floats:
        """The largest error on the intervals ``first``..``last``."""
        return np.zeros(first.shape) if self._error is None else self._error(first, last)

    def values(self, lower: Floats, upper: Floats, first: Integers, last: Integers) -> tuple[Floats, Floats]:
        """The smallest and largest value on ``[lower, upper]``, whose ends lie in ``first`` and ``last``."""
        left, right = self.value(lower, first), self.value(upper, last)
        least, greatest = np.minimum(left, right), np.maximum(left, right)
        if self.knots.size:
            # The knots inside a range are those from its first interval's right end on.
            greatest = np.maximum(greatest, self._highest(first, last - 1))
            least = np.minimum(least, -self._lowest(first, last - 1))
        return least, greatest
