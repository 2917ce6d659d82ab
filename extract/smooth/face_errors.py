"""Proved bounds on ``|f_true|`` on every polygon of a surface that was extracted with surrogates.

On the surface the network ``f`` of surrogates is zero up to rounding, so these are bounds on ``|f_true - f|`` there;
but the surrogates play no part. Polygons side by side form a *patch*, on which the true network is affine up to a
radius (`mn_onnx.extract.smooth.patch_bound`); on each polygon of it the affine function is largest at a corner.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, index_dtype, resolve_threads, run_blocks, run_matrix_blocks
from mn_onnx.extract.kernels.neighbours import order_by_halves
from mn_onnx.extract.kernels.patches import Polygons
from mn_onnx.extract.smooth.faces import mean_over_corners
from mn_onnx.extract.smooth.patch_bound import PatchBound
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.network import Floats, Integers, Network

BLOCK = 1 << 13
"""Polygons that are put in order together; a multiple of the patches."""

LARGEST_PATCH, SMALLEST_PATCH = 256, 8
"""Polygons of a patch, powers of two. Below the smaller number patches cost more than closer bounds are worth, unless
there are no more than `CHEAP` of them.
"""

CHEAP = 1 << 13

LOOSER = 1.25
"""How much looser bounds may be in the median than those of polygons on their own, where patches may be smaller."""

DIVIDED, NEGLIGIBLE = 3.0, 0.1
"""Patches are divided whose radius is so many times the typical one, but not for this part of the typical bound."""

PLACES = 128
"""Places on the surface by which patches are sized."""


def surface_errors(
    network: Network, surface: Surface, lower: Floats, upper: Floats, *, threads: int | None = None
) -> Floats:
    """`polygon_errors` of a surface, float64 [p]."""
    return polygon_errors(network, surface.vertices, surface.offsets, surface.corners, lower, upper, threads=threads)


def polygon_errors(
    network: Network,
    vertices: Floats,
    offsets: NDArray[np.integer],
    corners: NDArray[np.integer],
    lower: Floats,
    upper: Floats,
    *,
    threads: int | None = None,
) -> Floats:
    """Proved bounds on ``|f_true|``, float64 [p], on polygons; zeros where canonical ``network`` has no surrogates.

    ``vertices``: float64 [v, d], d the dimension of the network; polygon ``i`` is the convex hull of
    ``vertices[corners[offsets[i]:offsets[i + 1]]]`` (two of them for a segment). ``lower``, ``upper``: float64 [d], the
    box that the network was canonicalised for, in which the vertices are. Bounds are closest, and found fastest, where
    polygons that follow one another are close to one another. Raises ``ValueError`` for a network without tables.
    """
    errors = np.zeros(offsets.size - 1)
    if not any(unit.table is None or unit.table.errors.any() for unit in network.units) or not errors.size:
        return errors
    bound = PatchBound(network, np.asarray(lower, np.float64), np.asarray(upper, np.float64))
    polygons = Polygons(
        np.ascontiguousarray(vertices, np.float64),
        np.ascontiguousarray(offsets, np.int64),
        np.ascontiguousarray(corners),
    )
    threads = resolve_threads(threads)
    order = np.empty(errors.size, index_dtype(errors.size))
    n_blocks = -(-errors.size // BLOCK)
    run_blocks(lambda first, last: _order_blocks(polygons, first, last, order), n_blocks, threads)
    size, enough = _patch_size(bound, polygons, order, errors)

    def work(first: int, last: int) -> None:
        # Each block by itself: what is multiplied together, and so its rounding, does not depend on the threads.
        for block in range(first, last):
            end = min((block + 1) * BLOCK, errors.size)
            begins = np.arange(block * BLOCK, end, size)
            ends = np.minimum(begins + size, end)
            while begins.size:
                radii = bound(polygons, order, begins, ends, errors)
                divided = (radii > enough) & (ends > begins + 1)
                begins, ends = _halves(begins[divided], ends[divided])

    run_matrix_blocks(work, n_blocks, threads)
    return errors


def _order_blocks(polygons: Polygons, first: int, last: int, order: Indices) -> None:
    """The polygons of each block so that patches are runs in ``order``."""
    for block in range(first, last):
        begin, end = block * BLOCK, min((block + 1) * BLOCK, order.size)
        numbers = np.arange(end - begin)
        order_by_halves(mean_over_corners(*polygons, np.arange(begin, end)), numbers)
        order[begin:end] = begin + numbers


def _patch_size(bound: PatchBound, polygons: Polygons, order: Indices, errors: Floats) -> tuple[int, float]:
    """Polygons in a patch, and the radius beyond which a patch is divided: by what is found at some places."""
    smallest = min(SMALLEST_PATCH, -(-order.size // CHEAP))
    chosen = np.unique(np.linspace(0, order.size - 1, PLACES).astype(np.int64))
    size, enough, allowed = 1, 0.0, np.inf
    while size <= LARGEST_PATCH:
        begins = np.unique(chosen // size * size)
        radii = bound(polygons, order, begins, np.minimum(begins + size, order.size), errors)
        found = float(np.median(errors[order[begins]]))
        if size == 1:
            allowed = LOOSER * found
        if size > smallest and found > allowed:
            break
        enough = max(DIVIDED * float(np.median(radii)), NEGLIGIBLE * found)
        size *= 2
    return size // 2, enough


def _halves(begins: Integers, ends: Integers) -> tuple[Integers, Integers]:
    middles = (begins + ends) // 2
    return np.stack([begins, middles], axis=1).reshape(-1), np.stack([middles, ends], axis=1).reshape(-1)
