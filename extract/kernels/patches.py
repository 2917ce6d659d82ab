"""Kernels of the proved values of a smooth network on patches of a surface: one level of units, many patches.

All arrays are float64 unless said otherwise. A *patch* is some polygons side by side; it lies in a box with axes of its
own, ``centre + sum_i s_i axes[i]`` with ``|s_i| <= half[i]``. On it every variable of the true network is an affine
*form* in ``s`` (its value at the centre, then its derivatives) up to a radius. A *kind* is one scalar function with a
table that follows it closely, shared by many units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.kernel import threaded_kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

EPS = float(np.finfo(np.float64).eps)


class Tables(NamedTuple):
    """One-output tables one after another in flat arrays.

    ``first``: int64 [k + 1], the first interval of each. ``starts``, ``slopes``, ``intercepts``, ``errors``:
    [intervals]; an interval lasts until the next one starts, the first of a table starts at minus infinity.
    """

    first: Integers
    starts: Floats
    slopes: Floats
    intercepts: Floats
    errors: Floats


class Relaxed(NamedTuple):
    """Of a level's outputs on each patch, [n, o]: ``slope * t + intercept +- error`` holds the true function."""

    slope: Floats
    intercept: Floats
    error: Floats


class Polygons(NamedTuple):
    """Polygon ``i`` has the corners ``corners[offsets[i]:offsets[i + 1]]``, numbers of ``vertices`` [v, d]."""

    vertices: Floats
    offsets: Integers
    corners: NDArray[np.integer]


@threaded_kernel
def patch_moments(
    polygons: Polygons, order: NDArray[np.integer], begins: Integers, ends: Integers, centre: Floats, moments: Floats
) -> None:
    """Mean [n, d] and second moments [n, d, d] of the corners of each patch: polygons ``order[begins[k]:ends[k]]``."""
    vertices, offsets, corners = polygons.vertices, polygons.offsets, polygons.corners
    dimension = vertices.shape[1]
    centre[:] = 0.0
    moments[:] = 0.0
    for patch in range(begins.size):
        count = 0
        for polygon in order[begins[patch] : ends[patch]]:
            count += offsets[polygon + 1] - offsets[polygon]
            for corner in range(offsets[polygon], offsets[polygon + 1]):
                for axis in range(dimension):
                    centre[patch, axis] += vertices[corners[corner], axis]
        for axis in range(dimension):
            centre[patch, axis] /= count
        for polygon in order[begins[patch] : ends[patch]]:
            for corner in range(offsets[polygon], offsets[polygon + 1]):
                for axis in range(dimension):
                    along = vertices[corners[corner], axis] - centre[patch, axis]
                    for other in range(dimension):
                        across = vertices[corners[corner], other] - centre[patch, other]
                        moments[patch, axis, other] += along * across


@threaded_kernel
def patch_extents(
    polygons: Polygons,
    order: NDArray[np.integer],
    begins: Integers,
    ends: Integers,
    centre: Floats,
    axes: Floats,
    half: Floats,
) -> None:
    """How far the corners of each patch reach along its ``axes`` [n, d, d] from its centre: ``half`` [n, d]."""
    vertices, offsets, corners = polygons.vertices, polygons.offsets, polygons.corners
    dimension = vertices.shape[1]
    half[:] = 0.0
    for patch in range(begins.size):
        for polygon in order[begins[patch] : ends[patch]]:
            for corner in range(offsets[polygon], offsets[polygon + 1]):
                for axis in range(dimension):
                    along = 0.0
                    for k in range(dimension):
                        along += axes[patch, axis, k] * (vertices[corners[corner], k] - centre[patch, k])
                    half[patch, axis] = max(half[patch, axis], abs(along))
        # Rounding of the coordinates, and of axes that are orthonormal up to rounding.
        reach = 0.0
        for axis in range(dimension):
            reach += abs(centre[patch, axis]) + half[patch, axis]
        for axis in range(dimension):
            half[patch, axis] += 64 * EPS * reach


@threaded_kernel
def find_interval(starts: Floats, first: int, end: int, guess: int, t: float) -> int:
    """The interval of ``t`` among ``first`` .. ``end - 1``, by steps from ``guess`` that double, then by halves."""
    low, high, step = guess, guess + 1, 1
    while high < end and starts[high] <= t:
        low, high, step = high, min(high + step, end), 2 * step
    while starts[low] > t:
        low, high, step = max(low - step, first), low, 2 * step
    while high - low > 1:
        middle = (low + high) >> 1
        if starts[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@threaded_kernel
def relax_level(
    tables: Tables,
    owner: Integers,
    kind: Integers,
    limits: tuple[Floats, Floats],
    of_t: tuple[Floats, Floats],
    half: Floats,
    result: Relaxed,
) -> None:
    """Relax output ``j``, of kind ``kind[j]`` and unit ``owner[j]`` (int64 [o] each), on each patch.

    The line is parallel to the function's chord: none is closer where the slope rises, or falls, all the way.
    ``limits``: [u] each, proved bounds of the pre-activations. ``of_t``: their forms [n, 1 + d, u], and sizes
    [n, 2, u], of which the first is the radius and the second the rounding. ``half``: [n, d].
    """
    forms, sizes = of_t
    lowest, highest = limits
    starts, slopes, intercepts, errors = tables.starts, tables.slopes, tables.intercepts, tables.errors
    lines, shifts, misses = result.slope, result.intercept, result.error
    # Patches that follow one another are close to one another.
    begins, ends = tables.first[kind], tables.first[kind + 1]
    last = begins.copy()
    low, high = np.empty(forms.shape[2]), np.empty(forms.shape[2])
    for patch in range(forms.shape[0]):
        pre_activation_ranges(forms[patch], sizes[patch], half[patch], lowest, highest, low, high)
        for output in range(owner.size):
            a, b, end = low[owner[output]], high[owner[output]], ends[output]
            i = last[output]
            if a < starts[i] or (i + 1 < end and starts[i + 1] <= a):
                i = find_interval(starts, begins[output], end, i, a)
                last[output] = i
            slope, intercept, error = slopes[i], intercepts[i], errors[i]
            farthest = max(abs(a), abs(b))
            size = abs(slope) * farthest + abs(intercept)
            if i + 1 < end and starts[i + 1] <= b:
                k = i + 1
                while k + 1 < end and starts[k + 1] <= b:
                    k += 1
                slope = ((slopes[k] * b + intercepts[k]) - (slopes[i] * a + intercepts[i])) / (b - a)
                # On a tiny range that is mostly rounding; the slope of a chord is among those of its pieces.
                flattest = steepest = slopes[i]
                for piece in range(i + 1, k + 1):
                    flattest, steepest = min(flattest, slopes[piece]), max(steepest, slopes[piece])
                slope = min(max(slope, flattest), steepest)
                at_a, at_b = (slopes[i] - slope) * a + intercepts[i], (slopes[k] - slope) * b + intercepts[k]
                least, greatest = min(at_a - errors[i], at_b - errors[k]), max(at_a + errors[i], at_b + errors[k])
                while k > i:
                    at_knot = (slopes[k] - slope) * starts[k] + intercepts[k]
                    worse = max(errors[k - 1], errors[k])
                    least, greatest = min(least, at_knot - worse), max(greatest, at_knot + worse)
                    size = max(size, abs(slopes[k]) * farthest + abs(intercepts[k]))
                    k -= 1
                intercept, error = 0.5 * (least + greatest), 0.5 * (greatest - least)
            lines[patch, output] = slope
            shifts[patch, output] = intercept
            # A table's lines meet at a knot up to 8 units in the last place; with products and sums.
            misses[patch, output] = error + 32 * EPS * size


@threaded_kernel
def pre_activation_ranges(
    forms: Floats, sizes: Floats, half: Floats, lowest: Floats, highest: Floats, low: Floats, high: Floats
) -> None:
    """The range of each pre-activation on one patch, within its ``lowest`` and ``highest``: ``low``, ``high`` [u]."""
    for unit in range(low.size):
        high[unit] = sizes[0, unit] + sizes[1, unit]
    for axis in range(half.size):
        for unit in range(low.size):
            high[unit] += abs(forms[1 + axis, unit]) * half[axis]
    for unit in range(low.size):
        at, reach = forms[0, unit], high[unit]
        low[unit] = min(max(at - reach, lowest[unit]), highest[unit])
        high[unit] = max(low[unit], min(at + reach, highest[unit]))


@threaded_kernel
def output_forms(
    relaxed: Relaxed,
    owner: Integers,
    outputs: Integers,
    of_t: tuple[Floats, Floats],
    half: Floats,
    rounding: float,
    of_variables: tuple[Floats, Floats],
) -> None:
    """Forms and sizes of a level's outputs from those of its pre-activations, as `relax_level` has them.

    Written at the variables ``outputs`` (int64 [o]) of forms [n, 1 + d, v] and sizes [n, 2, v]. ``rounding``: of a sum
    that reads the outputs, relative to its terms.
    """
    forms, sizes = of_t
    target, target_sizes = of_variables
    for patch in range(forms.shape[0]):
        for output in range(owner.size):
            unit, variable = owner[output], outputs[output]
            slope, intercept = relaxed.slope[patch, output], relaxed.intercept[patch, output]
            value = slope * forms[patch, 0, unit] + intercept
            target[patch, 0, variable] = value
            reach, term = 0.0, abs(slope * forms[patch, 0, unit])
            for axis in range(half.shape[1]):
                along = slope * forms[patch, 1 + axis, unit]
                target[patch, 1 + axis, variable] = along
                reach += abs(along) * half[patch, axis]
            steepness = abs(slope)
            target_sizes[patch, 0, variable] = steepness * sizes[patch, 0, unit] + relaxed.error[patch, output]
            target_sizes[patch, 1, variable] = (
                steepness * sizes[patch, 1, unit]
                + 4 * EPS * (term + abs(intercept) + reach)
                + rounding * (abs(value) + reach)
            )


@threaded_kernel
def polygon_maxima(
    polygons: Polygons,
    order: NDArray[np.integer],
    begins: Integers,
    ends: Integers,
    centre: Floats,
    forms: Floats,
    radius: Floats,
    largest: Floats,
) -> None:
    """The largest ``|forms[k, 0] + forms[k, 1:] . (x - centre[k])| + radius[k]`` on each polygon of each patch.

    Affine functions are largest at corners. ``largest``: [polygons], filled in.
    """
    vertices, offsets, corners = polygons.vertices, polygons.offsets, polygons.corners
    for patch in range(begins.size):
        for polygon in order[begins[patch] : ends[patch]]:
            most = 0.0
            for corner in range(offsets[polygon], offsets[polygon + 1]):
                value = forms[patch, 0]
                for axis in range(vertices.shape[1]):
                    value += forms[patch, 1 + axis] * (vertices[corners[corner], axis] - centre[patch, axis])
                most = max(most, abs(value))
            largest[polygon] = most + radius[patch]
