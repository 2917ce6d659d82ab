"""Linear relaxations of tables over many ranges at once, and how far the true functions may leave them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mn_onnx.ir.kernel import threaded_kernel
from mn_onnx.ir.network import Floats, Integers
from mn_onnx.ir.surrogate.local_deviation import DeviationProfile

EPS = float(np.finfo(np.float64).eps)
# A table's lines meet at a knot up to 8 units in the last place (`mn_onnx.ir.surrogate.fit`); with products and sums.
TABLE_ROUNDING = 16 * EPS


class FlatProfiles(NamedTuple):
    """Deviation profiles one after another: ``first`` int64 [k + 1] is where each begins; else float64 [cells]."""

    first: Integers
    starts: Floats
    slopes: Floats
    intercepts: Floats
    lowest: Floats
    highest: Floats


class CellRelaxations(NamedTuple):
    """Of every output in every box, float64 [n, o].

    The table lies in ``slope * t + middle +- spread`` for ``t`` in the box's range. Where the true pre-activation is
    ``t + dt``, the true output differs from the table at ``t`` by ``slope * dt + shift +- jump``. ``reach``: the
    largest ``|output|`` of either.
    """

    slope: Floats
    middle: Floats
    spread: Floats
    shift: Floats
    jump: Floats
    reach: Floats


def flat_profiles(profiles: Sequence[DeviationProfile]) -> FlatProfiles:
    """``profiles`` one after another."""
    sizes = [profile.starts.size for profile in profiles]
    parts = (np.concatenate([profile[index] for profile in profiles]) for index in range(5))
    return FlatProfiles(np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)]), *parts)


@threaded_kernel
def _cell(starts: Floats, low: int, end: int, t: float) -> int:
    """The cell of ``t`` among ``low`` .. ``end - 1``."""
    high = end - 1
    while low < high:
        middle = (low + high + 1) >> 1
        if starts[middle] <= t:
            low = middle
        else:
            high = middle - 1
    return low


@threaded_kernel
def _relax(
    profiles: FlatProfiles,
    owner: Integers,
    kind: Integers,
    of_table: tuple[Floats, Floats],
    of_difference: tuple[Floats, Floats],
    limits: tuple[Floats, Floats],
    result: CellRelaxations,
) -> None:
    starts, slopes, intercepts = profiles.starts, profiles.slopes, profiles.intercepts
    for box in range(of_table[0].shape[0]):
        for output in range(owner.size):
            unit, which = owner[output], kind[output]
            low, high = of_table[0][box, unit], of_table[1][box, unit]
            less, more = of_difference[0][box, unit], of_difference[1][box, unit]
            true_low, true_high = max(low + less, limits[0][unit]), min(high + more, limits[1][unit])
            wide_low, wide_high = min(low, true_low), max(high, true_high)
            first = _cell(starts, profiles.first[which], profiles.first[which + 1], wide_low)
            last = _cell(starts, first, profiles.first[which + 1], wide_high)
            flattest, steepest = slopes[first], slopes[first]
            for cell in range(first + 1, last + 1):
                flattest, steepest = min(flattest, slopes[cell]), max(steepest, slopes[cell])
            # The slope that leaves least of ``|slope - s| |dt|`` over all slopes s between both pre-activations.
            slope = 0.5 * (flattest + steepest)
            least, greatest, bottom, top, below, above = np.inf, -np.inf, np.inf, -np.inf, np.inf, -np.inf
            for cell in range(first, last + 1):
                left = max(starts[cell], wide_low)
                right = wide_high if cell == last else starts[cell + 1]
                at_left, at_right = slopes[cell] * left + intercepts[cell], slopes[cell] * right + intercepts[cell]
                least, greatest = min(least, at_left, at_right), max(greatest, at_left, at_right)
                if left <= high and right >= low:
                    left, right = max(left, low), min(right, high)
                    tilt = slopes[cell] - slope
                    at_left, at_right = tilt * left + intercepts[cell], tilt * right + intercepts[cell]
                    bottom, top = min(bottom, at_left, at_right), max(top, at_left, at_right)
                if max(starts[cell], wide_low) <= true_high and (cell == last or starts[cell + 1] >= true_low):
                    below, above = min(below, profiles.lowest[cell]), max(above, profiles.highest[cell])
            off = max(abs(less), abs(more))
            largest = max(abs(least), abs(greatest))
            rounding = TABLE_ROUNDING * (abs(slope) * max(abs(wide_low), abs(wide_high)) + largest)
            by_slope = max(steepest - slope, slope - flattest) * off
            by_value = greatest - least + abs(slope) * off
            result.slope[box, output] = slope
            result.middle[box, output] = 0.5 * (top + bottom)
            result.spread[box, output] = 0.5 * (top - bottom) + rounding
            result.shift[box, output] = 0.5 * (below + above)
            result.jump[box, output] = (min(by_slope, by_value) + 0.5 * (above - below)) * (1 + 8 * EPS) + rounding
            result.reach[box, output] = largest + max(abs(below), abs(above)) + rounding


def relax_cells(
    profiles: FlatProfiles,
    owner: Integers,
    kind: Integers,
    of_table: tuple[Floats, Floats],
    of_difference: tuple[Floats, Floats],
    limits: tuple[Floats, Floats],
) -> CellRelaxations:
    """Relax output ``j``, which follows profile ``kind[j]`` of unit ``owner[j]`` (int64 [o] each), in ``n`` boxes.

    ``of_table``: float64 [n, u] each, the ranges of the pre-activations in the network of tables;
    ``of_difference``: the same of what the true ones differ by; ``limits``: float64 [u] each, between which both lie.
    """
    shape = (of_table[0].shape[0], owner.size)
    result = CellRelaxations(*(np.empty(shape) for _ in CellRelaxations._fields))
    _relax(profiles, owner, kind, of_table, of_difference, limits, result)
    return result
