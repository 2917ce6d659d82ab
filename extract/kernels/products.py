"""Products of block-triangular matrices in the arenas, in register tiles as wide as the levels of a system allow."""

from __future__ import annotations

from mn_onnx.extract.kernels.lanes import fma, load_like, load_wide, splat, splat_like, splat_wide, store
from mn_onnx.extract.kernels.memory import SINCE, UNTIL
from mn_onnx.ir.kernel import inlined_kernel, kernel

# So many numbers of a column are summed in registers at a time.
TILE = 16


@kernel
def accumulate(F, J, M, target, targets, begin, end, rows, sources, first, count, coefficients, stride):
    """Add to each of ``targets`` columns of ``rows`` numbers the columns at F[sources] times coefficients.

    target t[q] += sum_p F[coefficients + p * stride + t] * source p[q], for ``begin <= q < end``, a multiple of four,
    and ``first <= p < count``. Source ``p`` is zero before J[SINCE] and from J[UNTIL] on, both ascending with p, and
    zeros are written there for the length of a tile. So about two thirds of all products are left out: settled units
    read only earlier levels and are read only by later ones.

    Register tiles of 4 x 16: all targets go through one narrow panel of the sources, which stays in the nearest cache,
    then the next.
    """
    q, last = begin, first
    while q < end:
        width = TILE if q + TILE <= end else (8 if q + 8 <= end else 4)
        while first < count and J[UNTIL * M + first] <= q:
            first += 1
        last = max(first, last)
        while last < count and J[SINCE * M + last] < q + width:
            last += 1
        source, coefficient = sources + first * rows + q, coefficients + first * stride
        for t in range(0, targets, 4):
            at, left, weight, n = target + t * rows + q, targets - t, coefficient + t, last - first
            if width == TILE:
                accumulate_tile(F, at, left, rows, source, n, weight, stride)
            elif width == 8:
                accumulate_lanes(splat_wide(0.0), F, at, left, rows, source, n, weight, stride)
            else:
                accumulate_lanes(splat(0.0), F, at, left, rows, source, n, weight, stride)
        q += width


@kernel
def accumulate_tile(F, t0, targets, rows, source, count, at, stride):
    """`accumulate` for sixteen ``q`` and up to four targets; where there are fewer, the last one again."""
    one, two, three = min(1, targets - 1), min(2, targets - 1), min(3, targets - 1)
    t1, t2, t3 = t0 + one * rows, t0 + two * rows, t0 + three * rows
    a0, a1, a2, a3 = load_wide(F, t0), load_wide(F, t1), load_wide(F, t2), load_wide(F, t3)
    b0, b1, b2, b3 = load_wide(F, t0 + 8), load_wide(F, t1 + 8), load_wide(F, t2 + 8), load_wide(F, t3 + 8)
    for _ in range(count):
        u, v = load_wide(F, source), load_wide(F, source + 8)
        w0, w1 = splat_wide(F[at]), splat_wide(F[at + one])
        w2, w3 = splat_wide(F[at + two]), splat_wide(F[at + three])
        a0, b0 = fma(w0, u, a0), fma(w0, v, b0)
        a1, b1 = fma(w1, u, a1), fma(w1, v, b1)
        a2, b2 = fma(w2, u, a2), fma(w2, v, b2)
        a3, b3 = fma(w3, u, a3), fma(w3, v, b3)
        source += rows
        at += stride
    store(F, t0, a0)
    store(F, t1, a1)
    store(F, t2, a2)
    store(F, t3, a3)
    store(F, t0 + 8, b0)
    store(F, t1 + 8, b1)
    store(F, t2 + 8, b2)
    store(F, t3 + 8, b3)


@inlined_kernel
def accumulate_lanes(like, F, t0, targets, rows, source, count, at, stride):
    """`accumulate_tile` for as many ``q`` as ``like`` has lanes."""
    one, two, three = min(1, targets - 1), min(2, targets - 1), min(3, targets - 1)
    t1, t2, t3 = t0 + one * rows, t0 + two * rows, t0 + three * rows
    a0, a1 = load_like(like, F, t0), load_like(like, F, t1)
    a2, a3 = load_like(like, F, t2), load_like(like, F, t3)
    for _ in range(count):
        u = load_like(like, F, source)
        a0 = fma(splat_like(like, F[at]), u, a0)
        a1 = fma(splat_like(like, F[at + one]), u, a1)
        a2 = fma(splat_like(like, F[at + two]), u, a2)
        a3 = fma(splat_like(like, F[at + three]), u, a3)
        source += rows
        at += stride
    store(F, t0, a0)
    store(F, t1, a1)
    store(F, t2, a2)
    store(F, t3, a3)
