"""Products of dense matrices in the arenas, in register tiles as wide as the levels of a system allow."""

from __future__ import annotations

from numba import njit

from mn_onnx.extract.kernels.lanes import fma, load_like, load_wide, splat, splat_like, splat_wide, store


@njit(cache=True, error_model="numpy")
def accumulate(F, target, begin, end, rows, gathered, first, count, coefficients, stride):
    """F[target + q] += sum_p F[coefficients + p * stride] * F[gathered + p * rows + q].

    Over ``begin <= q < end``, a multiple of four, and ``first <= p < count``.
    """
    q = begin
    while q + 32 <= end:
        t = target + q
        a, b, c, d = load_wide(F, t), load_wide(F, t + 8), load_wide(F, t + 16), load_wide(F, t + 24)
        source = gathered + first * rows + q
        at = coefficients + first * stride
        for _ in range(first, count):
            w = splat_wide(F[at])
            a = fma(w, load_wide(F, source), a)
            b = fma(w, load_wide(F, source + 8), b)
            c = fma(w, load_wide(F, source + 16), c)
            d = fma(w, load_wide(F, source + 24), d)
            source += rows
            at += stride
        store(F, t, a)
        store(F, t + 8, b)
        store(F, t + 16, c)
        store(F, t + 24, d)
        q += 32
    while q + 8 <= end:
        accumulate_lanes(splat_wide(0.0), F, target + q, rows, gathered + q, first, count, coefficients, stride)
        q += 8
    if q < end:
        accumulate_lanes(splat(0.0), F, target + q, rows, gathered + q, first, count, coefficients, stride)


@njit(cache=True, error_model="numpy")
def accumulate_lanes(like, F, target, rows, gathered, first, count, coefficients, stride):
    """`accumulate` for as many ``q`` as ``like`` has lanes."""
    a = load_like(like, F, target)
    source = gathered + first * rows
    at = coefficients + first * stride
    for _ in range(first, count):
        a = fma(splat_like(like, F[at]), load_like(like, F, source), a)
        source += rows
        at += stride
    store(F, target, a)


@njit(cache=True, error_model="numpy")
def accumulate_four(
    F, target, begin, end, rows, gathered, first, count, coefficients, stride, blocks, target_step, coefficient_step
):
    """`accumulate` for ``blocks`` times four targets, ``rows`` apart, whose coefficients are neighbours.

    The targets of the next four begin ``target_step`` on, their coefficients ``coefficient_step``. Register tiles of
    4 x 16: all blocks go through one narrow panel of F[gathered], which stays in the nearest cache, then the next.
    """
    q = begin
    while q + 16 <= end:
        for block in range(blocks):
            t0 = target + block * target_step + q
            t1, t2, t3 = t0 + rows, t0 + 2 * rows, t0 + 3 * rows
            a0, a1, a2, a3 = load_wide(F, t0), load_wide(F, t1), load_wide(F, t2), load_wide(F, t3)
            b0, b1, b2, b3 = load_wide(F, t0 + 8), load_wide(F, t1 + 8), load_wide(F, t2 + 8), load_wide(F, t3 + 8)
            source = gathered + first * rows + q
            at = coefficients + block * coefficient_step + first * stride
            for _ in range(first, count):
                u, v = load_wide(F, source), load_wide(F, source + 8)
                w0, w1 = splat_wide(F[at]), splat_wide(F[at + 1])
                w2, w3 = splat_wide(F[at + 2]), splat_wide(F[at + 3])
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
        q += 16
    for block in range(blocks if q < end else 0):
        at, t = coefficients + block * coefficient_step, target + block * target_step + q
        if q + 8 <= end:
            accumulate_four_lanes(splat_wide(0.0), F, t, rows, gathered + q, first, count, at, stride)
            if q + 8 < end:
                accumulate_four_lanes(splat(0.0), F, t + 8, rows, gathered + q + 8, first, count, at, stride)
        else:
            accumulate_four_lanes(splat(0.0), F, t, rows, gathered + q, first, count, at, stride)


@njit(cache=True, error_model="numpy")
def accumulate_four_lanes(like, F, target, rows, gathered, first, count, coefficients, stride):
    """`accumulate_four` for as many ``q`` as ``like`` has lanes."""
    t1, t2, t3 = target + rows, target + 2 * rows, target + 3 * rows
    a0, a1 = load_like(like, F, target), load_like(like, F, t1)
    a2, a3 = load_like(like, F, t2), load_like(like, F, t3)
    source = gathered + first * rows
    at = coefficients + first * stride
    for _ in range(first, count):
        u = load_like(like, F, source)
        a0 = fma(splat_like(like, F[at]), u, a0)
        a1 = fma(splat_like(like, F[at + 1]), u, a1)
        a2 = fma(splat_like(like, F[at + 2]), u, a2)
        a3 = fma(splat_like(like, F[at + 3]), u, a3)
        source += rows
        at += stride
    store(F, target, a0)
    store(F, t1, a1)
    store(F, t2, a2)
    store(F, t3, a3)
