"""Compiles the kernels, or loads them from numba's cache, on a tiny network: so that this time is measured apart."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np

from mn_onnx.extract.blocks import index_dtype, resolve_threads
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.kernels.ahead import compile_ahead
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.second_compiler import compiling_beside

DIMENSION = 3
# Objects made between two collections of the first generation, and collections of one between two of the next.
FEW_COLLECTIONS = (50_000, 50, 50)


def warm_up(threads: int | None = None) -> Surface:
    """The octahedron |x| + |y| + |z| = 1 / 2; making it goes once through every kernel that extraction and checks need.

    Curves and roots need the same ones, as they are extracted in three dimensions. With two of ``threads`` (None: all
    cores) or more, a second process compiles the kernels for meshes and some of the traversal's, if need be, while this
    one compiles the others.
    """
    with _few_collections():
        with compiling_beside(__name__) if resolve_threads(threads) > 1 else nullcontext():
            soup, _ = traverse(_octahedral_network(), -np.ones(DIMENSION), np.ones(DIMENSION), threads=1)
        return _meshed(soup)


@contextmanager
def _few_collections() -> Iterator[None]:
    """Look for garbage rarely: among the many objects that numba makes and keeps it takes 7 % of a compilation."""
    thresholds = gc.get_threshold()
    if thresholds[0] > 0:  # 0: never
        gc.set_threshold(*FEW_COLLECTIONS)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


def _octahedral_network() -> Network:
    one = np.ones(1)
    table = KnotTable.exact([0.0], [[-1.0, 1.0]], [[0.0, 0.0]])
    units = tuple(
        Unit(AffineRow(np.array([axis]), one, 0.0), (table,), f"|x_{axis}|", table) for axis in range(DIMENSION)
    )
    total = AffineRow(np.arange(DIMENSION, 2 * DIMENSION), np.ones(DIMENSION), -0.5)
    return Network(DIMENSION, units, total)


def _octahedral_soup() -> PolygonSoup:
    """What the traversal of the octahedron's network gives, but for order and keys."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    # Counter-clockwise seen from outside in the octant where all are positive; every negative sign turns that over.
    axes = np.array([(0, 1, 2) if octant.prod() > 0 else (0, 2, 1) for octant in signs])
    ends = np.take_along_axis(signs, axes, 1).reshape(-1)
    axes = axes.reshape(-1)
    positions = np.zeros((axes.size, DIMENSION))
    positions[np.arange(axes.size), axes] = 0.5 * ends
    keys = np.stack([axes, ends > 0], 1).astype(np.uint64)
    offsets = np.arange(0, axes.size + 1, DIMENSION)
    return PolygonSoup(
        offsets.astype(np.int64),
        np.arange(axes.size, dtype=index_dtype(axes.size)),
        positions,
        keys,
        np.full(axes.size, -1, np.int8),
        signs.astype(np.float64),
        np.zeros(len(signs)),
    )


def _meshed(soup: PolygonSoup) -> Surface:
    surface = weld(soup, threads=1)
    check_invariants(surface)
    sample_surface(surface, 1)
    return surface


if __name__ == "__main__":
    # The second process: first the kernels that the traversal needs last, then those for meshes. What both compile must
    # be for the same types: written to the cache at the same time for different ones, numba gives both files one name.
    with _few_collections():
        compile_ahead()
        _meshed(_octahedral_soup())
