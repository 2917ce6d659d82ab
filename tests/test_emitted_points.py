"""Corners of one vertex share a point of the output buffers, unless they lie apart; `weld` joins the other points."""

from __future__ import annotations

import numpy as np
import pytest

from mn_onnx.extract import schedule
from mn_onnx.extract.kernels.leaf import APART, REMEMBERED, place_corner
from mn_onnx.extract.kernels.records import OutputArrays
from mn_onnx.extract.pipeline import _whole_polygons
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.extract.weld import weld
from oracle.random_networks import random_tables

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)


class Buffers:
    """Room for eight points, and what is remembered from other buffers."""

    def __init__(self, remembered: int = 0) -> None:
        self.arrays = OutputArrays(
            counts=np.zeros(3, np.int64),
            sizes=np.zeros(8, np.int32),
            gradients=np.zeros(24),
            corners=np.zeros(8, np.int32),
            positions=np.full(24, np.nan),
            keys=np.zeros(16, np.int64),
            box_faces=np.zeros(8, np.int8),
            remembered=np.full(REMEMBERED, remembered, np.int32),
        )
        self.points = 0

    def place(self, key0: int, key1: int, *position: float) -> int:
        found = int(place_corner(self.arrays, self.points, key0, key1, *position))
        self.points = max(self.points, found + 1)
        return found


def test_corners_at_one_place_with_one_key_share_a_point() -> None:
    buffers = Buffers()
    assert [buffers.place(5, 6, 0.1, 0.2, 0.3), buffers.place(7, 8, 0.4, 0.5, 0.6)] == [0, 1]
    assert [buffers.place(7, 8, 0.4, 0.5 + APART / 2, 0.6), buffers.place(5, 6, 0.1, 0.2, 0.3)] == [1, 0]
    np.testing.assert_array_equal(buffers.arrays.positions[:6], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    np.testing.assert_array_equal(buffers.arrays.keys[:4], [5, 6, 7, 8])


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("axis", range(3))
def test_corners_that_lie_apart_are_points_of_their_own(axis: int, size: float) -> None:
    buffers = Buffers()
    position = size * np.array([0.1, 0.2, 0.3])
    assert buffers.place(5, 6, *position) == 0
    position[axis] += 0.5 * APART * size
    assert buffers.place(5, 6, *position) == 0
    position[axis] += 0.5 * APART * size
    assert buffers.place(5, 6, *position) == 1
    position[axis] = np.nan
    assert [buffers.place(5, 6, *position), buffers.place(5, 6, *position)] == [2, 3]


@pytest.mark.parametrize("other", [(5, 7), (5 + REMEMBERED, 6), (-5, 6)])
def test_other_keys_are_other_points(other: tuple[int, int]) -> None:
    buffers = Buffers()
    assert [buffers.place(5, 6, 0.1, 0.2, 0.3), buffers.place(*other, 0.1, 0.2, 0.3)] == [0, 1]


@pytest.mark.parametrize("remembered", [0, 3, 7])
def test_points_of_earlier_buffers_are_not_taken_for_these(remembered: int) -> None:
    """Not even if what is left in the memory of these buffers looks like the point that is sought."""
    buffers = Buffers(remembered)
    buffers.arrays.positions.reshape(-1, 3)[remembered] = 0.1, 0.2, 0.3
    buffers.arrays.keys.reshape(-1, 2)[remembered] = 5, 6
    assert buffers.place(5, 6, 0.1, 0.2, 0.3) == 0
    np.testing.assert_array_equal(buffers.arrays.keys[:2], [5, 6])


def test_most_corners_share_points_and_small_buffers_change_no_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    network = random_tables(6, (8, 8), n_knots=6, n_outputs=3)
    soup, _ = traverse(network, LOWER, UPPER, threads=1)
    mesh = weld(soup)
    assert mesh.n_vertices <= len(soup.positions) < 1.1 * mesh.n_vertices
    monkeypatch.setattr(schedule, "BUFFER_CORNERS", 1 << 10)
    parts, _ = traverse(network, LOWER, UPPER, threads=1)
    assert len(parts.positions) > len(soup.positions)
    for name in ("vertices", "corners", "twins"):
        np.testing.assert_array_equal(getattr(weld(parts), name), getattr(mesh, name))


def test_points_of_polygons_that_are_left_out_are_left_out() -> None:
    """Polygons of two corners come and go with rounding; what remains has its points in the order of its corners."""
    corners = np.array([3, 0, 2, 1, 3, 1, 2, 4, 3], np.int32)
    order = np.argsort(np.unique(corners, return_index=True)[1])
    generator = np.random.default_rng(4)
    soup = PolygonSoup(
        offsets=np.array([0, 2, 5, 9]),
        corners=np.argsort(order)[corners].astype(np.int32),
        positions=generator.normal(size=(5, 3)),
        keys=generator.integers(0, 2**64, (5, 2), np.uint64),
        box_faces=np.arange(9, dtype=np.int8),
        gradients=generator.normal(size=(3, 3)),
        errors=np.arange(3.0),
    )
    whole, n_dropped = _whole_polygons(soup)
    assert n_dropped == 1
    np.testing.assert_array_equal(whole.corners, [0, 1, 2, 1, 0, 3, 2])
    assert whole.corners.dtype == soup.corners.dtype
    np.testing.assert_array_equal(whole.offsets, [0, 3, 7])
    for name in ("corner_positions", "corner_keys", "box_faces"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(soup, name)[2:])
    assert len(whole.positions) == len(whole.keys) == 4
