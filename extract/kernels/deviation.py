"""Kernels of the error bounds of polygons: one level of units, many polygons.

All arrays are float64 unless said otherwise. A *kind* is one scalar function with its table, shared by many units. On a
polygon every unit of the surrogate network stays on one interval ``i`` of its table, with the line ``L_i``. If ``t`` is
the unit's pre-activation there and ``t + dt`` the one in the true network, its output is off by

    phi(t + dt) - L_i(t) = slope_i * dt + D_i(t + dt),   D_i = phi - L_i

without any remainder, so that only the enclosure of ``D_i`` on the range of ``t + dt`` is an estimate.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Tables(NamedTuple):
    """One-output tables one after another in flat arrays.

    ``first``: int64 [k + 1], the first interval of each. ``starts``, ``slopes``, ``intercepts``, ``errors``:
    [intervals]; an interval lasts until the next one starts, the first of a table starts at minus infinity.
    ``steepest``: [k], the largest |slope| of each.
    """

    first: Integers
    starts: Floats
    slopes: Floats
    intercepts: Floats
    errors: Floats
    steepest: Floats


@numba.njit(cache=True, nogil=True)
def _interval(starts: Floats, low: int, end: int, guess: int, t: float) -> int:
    """The interval of ``t`` among ``low`` .. ``end - 1``; found at once if it is ``guess``."""
    if starts[guess] <= t and (guess + 1 == end or t < starts[guess + 1]):
        return guess
    high = end - 1
    while low < high:
        middle = (low + high + 1) >> 1
        if starts[middle] <= t:
            low = middle
        else:
            high = middle - 1
    return low


@numba.njit(cache=True, nogil=True)
def table_values(tables: Tables, owner: Integers, kind: Integers, t: Floats, result: Floats) -> None:
    """Outputs [n, o] at pre-activations ``t`` [n, u]; output ``j`` is table ``kind[j]`` of unit ``owner[j]``."""
    last = tables.first[kind]
    for point in range(t.shape[0]):
        for output in range(owner.size):
            which = kind[output]
            at = t[point, owner[output]]
            i = _interval(tables.starts, tables.first[which], tables.first[which + 1], last[output], at)
            last[output] = i
            result[point, output] = tables.slopes[i] * at + tables.intercepts[i]


@numba.njit(cache=True, nogil=True)
def corner_ranges(t: Floats, rows: Integers, offsets: Integers, low: Floats, high: Floats) -> None:
    """The least and greatest ``t`` [n, u] over the corners of each polygon.

    ``t`` [v, u]: at vertices; ``rows`` int64 [c]: the vertex of each corner; ``offsets`` int64 [n + 1].
    """
    for polygon in range(offsets.size - 1):
        first = rows[offsets[polygon]]
        for unit in range(t.shape[1]):
            low[polygon, unit] = high[polygon, unit] = t[first, unit]
        for corner in range(offsets[polygon] + 1, offsets[polygon + 1]):
            row = rows[corner]
            for unit in range(t.shape[1]):
                low[polygon, unit] = min(low[polygon, unit], t[row, unit])
                high[polygon, unit] = max(high[polygon, unit], t[row, unit])


@numba.njit(cache=True, nogil=True, inline="always")
def _deviation(
    tables: Tables, which: int, i: int, slope: float, intercept: float, a: float, b: float
) -> tuple[float, float]:
    """The range on ``[a, b]`` of the function that table ``which`` follows, less a line; ``a`` is in interval ``i``."""
    end = tables.first[which + 1]
    value = (tables.slopes[i] - slope) * a + (tables.intercepts[i] - intercept)
    least, greatest = value - tables.errors[i], value + tables.errors[i]
    while i + 1 < end and tables.starts[i + 1] <= b:
        i += 1
        value = (tables.slopes[i] - slope) * tables.starts[i] + (tables.intercepts[i] - intercept)
        error = max(tables.errors[i - 1], tables.errors[i])
        least, greatest = min(least, value - error), max(greatest, value + error)
    value = (tables.slopes[i] - slope) * b + (tables.intercepts[i] - intercept)
    return min(least, value - tables.errors[i]), max(greatest, value + tables.errors[i])


@numba.njit(cache=True, nogil=True)
def advance_errors(
    tables: Tables,
    finer: Tables,
    owner: Integers,
    kind: Integers,
    ranges: tuple[Floats, Floats],
    limits: tuple[Floats, Floats],
    rounding: Floats,
    of_t: tuple[Floats, Floats],
    slope: Floats,
    centre: Floats,
    radius: Floats,
    of_outputs: tuple[Floats, Floats],
) -> None:
    """Slopes of a level's outputs, enclosures ``centre +- radius`` of ``D_i``, and of their errors; all [n, o].

    ``tables``: those of the surrogate network; ``finer``: tables of the same functions, with smaller errors.
    ``ranges``: least and greatest pre-activations of the surrogate network on each polygon, [n, u] each, known up to
    ``rounding`` [u]. ``limits``: [u] each, proved bounds of all pre-activations of both networks. ``of_t``: the
    enclosure ``m +- r`` of ``dt``, [n, u] each; ``of_outputs``: that of the outputs' errors, filled in.
    """
    low, high = ranges
    lowest, highest = limits
    middle, spread = of_t
    output_middle, output_spread = of_outputs
    # Polygons that follow one another are close to one another.
    last, last_finer = tables.first[kind], finer.first[kind]
    for polygon in range(low.shape[0]):
        for output in range(owner.size):
            unit, which = owner[output], kind[output]
            begin, end = tables.first[which], tables.first[which + 1]
            at = 0.5 * (low[polygon, unit] + high[polygon, unit])
            home = _interval(tables.starts, begin, end, last[output], at)
            last[output] = home
            reach = spread[polygon, unit] + rounding[unit]
            a = max(low[polygon, unit] + middle[polygon, unit] - reach, lowest[unit])
            b = max(a, min(high[polygon, unit] + middle[polygon, unit] + reach, highest[unit]))
            line, shift = tables.slopes[home], tables.intercepts[home]
            first = _interval(finer.starts, finer.first[which], finer.first[which + 1], last_finer[output], a)
            last_finer[output] = first
            least, greatest = _deviation(finer, which, first, line, shift, a, b)
            slope[polygon, output] = line
            centre[polygon, output] = 0.5 * (least + greatest)
            # A corner may lie past the end of its interval by rounding, where the lines differ by so much.
            radius[polygon, output] = 0.5 * (greatest - least) + 2 * tables.steepest[which] * rounding[unit]
            output_middle[polygon, output] = line * middle[polygon, unit] + centre[polygon, output]
            output_spread[polygon, output] = abs(line) * spread[polygon, unit] + radius[polygon, output]
