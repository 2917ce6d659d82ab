"""The arrays that the kernels are called with, grouped by who owns them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Tables(NamedTuple):
    """The units' knot tables and the random words of the vertex keys.

    Knots of all units lie one after the other; unit ``u`` owns ``first_knot[u]:first_knot[u + 1]`` (int64 [units + 1]).
    Output ``k`` of unit ``u`` has its pieces at ``first_piece[u] + k * (knots of u + 1)``. The plane of a knot has the
    knot's index; box face ``f`` is plane ``n_knots + f``. ``state_hash`` (int64 [n_knots + units, 2]) has a word pair
    per unit and state, ``tag_hash`` (int64 [2 * n_knots + 12, 2]) what turns the hash of a cell's states into that of a
    vertex on the tagged plane. ``extent`` bounds the coordinates' magnitude on the box (at least 1).
    """

    first_knot: Integers
    knots: Floats
    first_piece: Integers
    slopes: Floats
    intercepts: Floats
    state_hash: Integers
    tag_hash: Integers
    n_knots: int
    extent: float


class WorkerArrays(NamedTuple):
    """One worker's memory; see `kernels.memory`.

    ``slice_floats`` and ``slice_integers`` are scratch like X and J, for the slices of a cell; see
    `kernels.slice_points`.
    """

    F: Floats
    N: Integers
    X: Floats
    J: Integers
    control: Integers
    stack: Integers
    slot_of_tag: Integers
    slice_floats: Floats
    slice_integers: Integers


class OutputArrays(NamedTuple):
    """One worker's output buffers; ``counts`` holds the numbers of polygons, corners and points in them.

    ``corners``: the point of each corner. ``remembered``: a recent point for each value of some bits of the keys; see
    `kernels.leaf.place_corner`.
    """

    counts: Integers
    sizes: NDArray[np.int32]
    gradients: Floats
    corners: NDArray[np.int32]
    positions: Floats
    keys: Integers
    box_faces: NDArray[np.int8]
    remembered: NDArray[np.int32]
