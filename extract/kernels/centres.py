"""Linear centres of pre-activations and their ranges over a cell's vertices; radii that add up whatever a row reads."""

from __future__ import annotations

from mn_onnx.extract.kernels.lanes import (
    fma,
    larger,
    load_like,
    load_wide,
    magnitude,
    prefetch,
    smaller,
    splat,
    splat_like,
    splat_wide,
    store,
)
from mn_onnx.extract.kernels.memory import (
    CELL_CAPACITY,
    CELL_FLOATS,
    CELL_VERTICES,
    GROWTH,
    HIGH,
    LOW,
    OUTPUTS,
    REACH,
    READ_AT,
    READ_RADIUS,
    weights_of,
)
from mn_onnx.ir.kernel import inlined_kernel, kernel


@kernel
def row_extremes(F, N, X, M, cell, begin, end):
    """LOW and HIGH of rows ``begin:end`` (multiples of the lane width) over the cell's vertices."""
    r = begin
    while r + 8 <= end:
        row_extremes_lanes(splat_wide(0.0), F, N, X, M, cell, r)
        r += 8
    if r < end:
        row_extremes_lanes(splat(0.0), F, N, X, M, cell, r)


@inlined_kernel
def row_extremes_lanes(like, F, N, X, M, cell, r):
    """`row_extremes` for as many rows from ``r`` on as ``like`` has lanes."""
    n, x, capacity = N[cell + CELL_VERTICES], N[cell + CELL_FLOATS], N[cell + CELL_CAPACITY]
    y, z = x + capacity, x + 2 * capacity
    c0, c1 = load_like(like, X, r), load_like(like, X, M + r)
    c2, c3 = load_like(like, X, 2 * M + r), load_like(like, X, 3 * M + r)
    low = fma(c0, splat_like(like, F[x]), fma(c1, splat_like(like, F[y]), fma(c2, splat_like(like, F[z]), c3)))
    high = low
    for v in range(1, n):
        value = fma(c2, splat_like(like, F[z + v]), c3)
        value = fma(c0, splat_like(like, F[x + v]), fma(c1, splat_like(like, F[y + v]), value))
        low = smaller(value, low)
        high = larger(value, high)
    store(X, LOW * M + r, low)
    store(X, HIGH * M + r, high)


@kernel
def read_outputs(F, X, J, M, floats, rows, begin, end, first, count):
    """Centres of rows ``begin:end``: their affine parts plus what they read of outputs ``first:count``.

    Also X[GROWTH], radii that add up whatever the rows read.
    """
    r = begin
    while r + 16 <= end:
        read_sixteen(F, X, J, M, floats, rows, r, first, count, False)
        r += 16
    if r + 8 <= end:
        read_outputs_lanes(splat_wide(0.0), F, X, J, M, floats, rows, r, first, count, False)
        r += 8
    if r < end:
        read_outputs_lanes(splat(0.0), F, X, J, M, floats, rows, r, first, count, False)


@kernel
def read_tracked_outputs(F, X, J, M, floats, rows, begin, end, first, count):
    """`read_outputs`, and X[REACH]: radii that add up the tracked radii of the outputs, X[READ_RADIUS]."""
    r = begin
    while r + 8 < end:
        read_sixteen(F, X, J, M, floats, rows, r, first, count, True)
        r += 16
    if r < end:
        read_outputs_lanes(splat_wide(0.0), F, X, J, M, floats, rows, r, first, count, True)


@inlined_kernel
def read_sixteen(F, X, J, M, floats, rows, r, first, count, tracked):
    """`read_outputs` for rows ``r : r + 16``, or `read_tracked_outputs`."""
    weights, s = weights_of(floats, rows) + r, r + 8
    outputs, places, radii = OUTPUTS * M, READ_AT * M, READ_RADIUS * M
    c0, c1 = load_wide(F, floats + r), load_wide(F, floats + rows + r)
    c2, c3 = load_wide(F, floats + 2 * rows + r), load_wide(F, floats + 3 * rows + r)
    d0, d1 = load_wide(F, floats + s), load_wide(F, floats + rows + s)
    d2, d3 = load_wide(F, floats + 2 * rows + s), load_wide(F, floats + 3 * rows + s)
    c4 = d4 = c5 = d5 = splat_wide(0.0)
    for p in range(first, count):
        at = weights + J[places + p]
        w, v = load_wide(F, at), load_wide(F, at + 8)
        # The next rows' weights: a column is a page or more, so the machine would not foresee them.
        prefetch(F, at + 16)
        prefetch(F, at + 24)
        y = outputs + p
        y0, y1, y2, y3, y4 = (
            splat_wide(X[y]),
            splat_wide(X[y + M]),
            splat_wide(X[y + 2 * M]),
            splat_wide(X[y + 3 * M]),
            splat_wide(X[y + 4 * M]),
        )
        c0, d0 = fma(w, y0, c0), fma(v, y0, d0)
        c1, d1 = fma(w, y1, c1), fma(v, y1, d1)
        c2, d2 = fma(w, y2, c2), fma(v, y2, d2)
        c3, d3 = fma(w, y3, c3), fma(v, y3, d3)
        c4, d4 = fma(magnitude(w), y4, c4), fma(magnitude(v), y4, d4)
        if tracked:
            y5 = splat_wide(X[radii + p])
            c5, d5 = fma(magnitude(w), y5, c5), fma(magnitude(v), y5, d5)
    store(X, r, c0)
    store(X, M + r, c1)
    store(X, 2 * M + r, c2)
    store(X, 3 * M + r, c3)
    store(X, GROWTH * M + r, c4)
    store(X, s, d0)
    store(X, M + s, d1)
    store(X, 2 * M + s, d2)
    store(X, 3 * M + s, d3)
    store(X, GROWTH * M + s, d4)
    if tracked:
        store(X, REACH * M + r, c5)
        store(X, REACH * M + s, d5)


@inlined_kernel
def read_outputs_lanes(like, F, X, J, M, floats, rows, r, first, count, tracked):
    """`read_sixteen` for as many rows as ``like`` has lanes."""
    outputs, places, radii = OUTPUTS * M, READ_AT * M, READ_RADIUS * M
    weights = weights_of(floats, rows) + r
    c0, c1 = load_like(like, F, floats + r), load_like(like, F, floats + rows + r)
    c2, c3 = load_like(like, F, floats + 2 * rows + r), load_like(like, F, floats + 3 * rows + r)
    growth = reach = splat_like(like, 0.0)
    for p in range(first, count):
        w = load_like(like, F, weights + J[places + p])
        y = outputs + p
        c0 = fma(w, splat_like(like, X[y]), c0)
        c1 = fma(w, splat_like(like, X[y + M]), c1)
        c2 = fma(w, splat_like(like, X[y + 2 * M]), c2)
        c3 = fma(w, splat_like(like, X[y + 3 * M]), c3)
        growth = fma(magnitude(w), splat_like(like, X[y + 4 * M]), growth)
        if tracked:
            reach = fma(magnitude(w), splat_like(like, X[radii + p]), reach)
    store(X, r, c0)
    store(X, M + r, c1)
    store(X, 2 * M + r, c2)
    store(X, 3 * M + r, c3)
    store(X, GROWTH * M + r, growth)
    if tracked:
        store(X, REACH * M + r, reach)
