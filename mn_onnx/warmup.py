"""Compiles the kernels, or loads them from numba's cache, on a tiny network: so that this time is measured apart."""

from __future__ import annotations

import numpy as np

from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

DIMENSION = 3


def warm_up() -> Surface:
    """The octahedron |x| + |y| + |z| = 1 / 2; making it goes once through every kernel that extraction and checks need.

    Curves and roots need the same ones, as they are extracted in three dimensions.
    """
    one = np.ones(1)
    table = KnotTable.exact([0.0], [[-1.0, 1.0]], [[0.0, 0.0]])
    units = tuple(
        Unit(AffineRow(np.array([axis]), one, 0.0), (table,), f"|x_{axis}|", table) for axis in range(DIMENSION)
    )
    total = AffineRow(np.arange(DIMENSION, 2 * DIMENSION), np.ones(DIMENSION), -0.5)
    network = Network(DIMENSION, units, total)
    soup, _ = traverse(network, -np.ones(DIMENSION), np.ones(DIMENSION), threads=1)
    surface = weld(soup, threads=1)
    check_invariants(surface)
    sample_surface(surface, 1)
    return surface
