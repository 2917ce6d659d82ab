"""States of units that follow from their bounds, and linear relaxations of the undecided ones.

A unit of several pieces is relaxed by its chord over the range of its pre-activation.
"""

from __future__ import annotations

from mn_onnx.extract.kernels.lanes import fma, magnitude, splat_wide
from mn_onnx.extract.kernels.masks import choose, divide, either
from mn_onnx.extract.kernels.memory import (
    DEAD,
    ERROR,
    HIGH,
    LINEAR,
    LOW,
    OFFSET,
    RADIUS,
    SLOPE,
    STATE_HIGH,
    STATE_LOW,
    UNSTABLE,
)
from mn_onnx.ir.kernel import kernel

# Rounding of a bound, relative to the size of the centre it is around: 2^-40 is about 4000 units in the last place.
# Where terms cancel that are thousands of times larger than their sum, it may be more: then cells may decide a sign
# each for itself, which unmatched edges tell.
MARGIN = 2.0**-40


@kernel
def bound_radius(X, M, extent, r):
    """The radius of row ``r`` with what rounding may add; exactly 0 for a row that is affine on the cell."""
    radius = X[RADIUS * M + r]
    size = abs(X[r]) + abs(X[M + r]) + abs(X[2 * M + r]) + abs(X[3 * M + r]) + radius
    return radius + MARGIN * size * extent if radius > 0.0 else 0.0


@kernel
def with_rounding(c0, c1, c2, c3, radius, extent):
    """Radii around affine forms, with what rounding may add, in eight lanes."""
    one = splat_wide(1.0)
    size = fma(one, magnitude(c0), magnitude(c1))
    size = fma(one, magnitude(c3), fma(one, radius, fma(one, magnitude(c2), size)))
    return fma(size, splat_wide(MARGIN * extent), radius)


@kernel
def relax_one_knot(knot, left, left_at, right, right_at, low, high, above, under):
    """Slopes, offsets and errors over [low, high] of units of one knot and two pieces, in eight lanes.

    Exact where the masks say that the range is ``above`` or ``under`` the knot, else by the chord.
    """
    zero, half, minus = splat_wide(0.0), splat_wide(0.5), splat_wide(-1.0)
    at_low = fma(left, low, left_at)
    at_high = fma(right, high, right_at)
    # Halves, which are finite where the ends are.
    less = fma(minus, half, zero)
    chord = divide(fma(less, at_low, fma(half, at_high, zero)), fma(less, low, fma(half, high, zero)))
    deviation = fma(minus, at_low, fma(left, knot, left_at))
    deviation = fma(fma(minus, low, knot), fma(minus, chord, zero), deviation)
    middle = fma(half, deviation, fma(fma(minus, chord, zero), low, at_low))
    slope = choose(above, right, choose(under, left, chord))
    offset = choose(above, right_at, choose(under, left_at, middle))
    error = choose(either(above, under), zero, fma(half, magnitude(deviation), zero))
    return slope, offset, error


@kernel
def relax_piece_range(knots, slopes, intercepts, knot, piece, first, last, low, high):
    """Relax a table's pieces ``first..last``, more than one, by their chord over [low, high].

    Returns slope, offset and error with ``|y - slope t - offset| <= error``.
    """
    at_low = slopes[piece + first] * low + intercepts[piece + first]
    at_high = slopes[piece + last] * high + intercepts[piece + last]
    slope = (0.5 * at_high - 0.5 * at_low) / (0.5 * high - 0.5 * low)
    above, below = 0.0, 0.0
    for s in range(first, last):
        kappa = knots[knot + s]
        deviation = slopes[piece + s] * kappa + intercepts[piece + s] - (at_low + slope * (kappa - low))
        above = max(above, deviation)
        below = min(below, deviation)
    return slope, at_low - slope * low + 0.5 * (above + below), 0.5 * (above - below)


@kernel
def narrow_states(knots, knot, pieces, first, last, low, high):
    """The states ``first..last`` that pre-activations in [low, high] may have, and the part of the range in them."""
    while first < last and low >= knots[knot + first]:
        first += 1
    while last > first and high < knots[knot + last - 1]:
        last -= 1
    # A cell that was split here lies on one side of the knot, whatever the radius says.
    if first > 0 and low < knots[knot + first - 1] < high:
        low = knots[knot + first - 1]
    if last < pieces - 1 and low < knots[knot + last] < high:
        high = knots[knot + last]
    return first, last, low, high


@kernel
def settle_row(N, X, J, M, tables, cols, r, unit):
    """Tighten the state range of row ``r`` by its bounds and relax its outputs.

    Sets STATE_LOW, STATE_HIGH of the row and SLOPE, OFFSET, ERROR of its columns; returns its kind.
    """
    knot, knots = tables.first_knot[unit], tables.knots
    pieces = tables.first_knot[unit + 1] - knot + 1
    first, last = J[STATE_LOW * M + r], J[STATE_HIGH * M + r]
    low, high = X[LOW * M + r], X[HIGH * M + r]
    if first < last:
        reach = bound_radius(X, M, tables.extent, r)
        low -= reach
        high += reach
        first, last, low, high = narrow_states(knots, knot, pieces, first, last, low, high)
        J[STATE_LOW * M + r] = first
        J[STATE_HIGH * M + r] = last
        X[LOW * M + r] = low
        X[HIGH * M + r] = high
    piece = tables.first_piece[unit]
    kind = DEAD
    for c in range(N[cols + r], N[cols + r + 1]):
        if first == last:
            slope, offset, error = tables.slopes[piece + first], tables.intercepts[piece + first], 0.0
            kind = LINEAR if slope != 0.0 or offset != 0.0 else kind
        else:
            slope, offset, error = relax_piece_range(
                knots, tables.slopes, tables.intercepts, knot, piece, first, last, low, high
            )
        X[SLOPE * M + c] = slope
        X[OFFSET * M + c] = offset
        X[ERROR * M + c] = error
        piece += pieces
    return kind if first == last else UNSTABLE
