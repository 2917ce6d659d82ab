import numpy as np
import pytest
from known_meshes import cube, flatten, joined, torus

from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.surface import Surface


def test_points_lie_on_their_polygons():
    points, polygons = sample_surface(cube(2.0), 5000, seed=3)
    normals = cube(2.0).normals[polygons]
    np.testing.assert_allclose((points * normals).sum(axis=1), 1.0, atol=1e-15)
    assert np.abs(points).max() <= 1.0 + 1e-15


def test_polygons_are_met_in_proportion_to_their_area():
    surface = joined(cube(1.0), cube(3.0, (5.0, 0.0, 0.0)))
    _, polygons = sample_surface(surface, 200_000)
    shares = np.bincount(polygons, minlength=12) / 200_000
    np.testing.assert_allclose(shares, np.repeat([1 / 60, 9 / 60], 6), rtol=0.05)


def test_points_are_uniform_within_a_polygon_of_many_corners():
    n = 12
    angle = 2 * np.pi * np.arange(n) / n
    disc = Surface.from_polygons(
        np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), *flatten([list(range(n))])
    )
    points, _ = sample_surface(disc, 100_000)
    sector = (np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi) / (2 * np.pi) * n).astype(int)
    np.testing.assert_allclose(np.bincount(sector) / 100_000, 1 / n, rtol=0.06)
    inner = (np.hypot(points[:, 0], points[:, 1]) < 0.5).mean()
    assert inner == pytest.approx(np.pi * 0.25 / disc.area, rel=0.03)


def test_the_seed_decides():
    surface = torus()
    first, second, other = (sample_surface(surface, 100, seed=seed)[0] for seed in (1, 1, 2))
    assert first.tobytes() == second.tobytes()
    assert (first != other).any()


def test_polygons_without_area_are_never_met():
    vertices = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
    surface = Surface.from_polygons(vertices, *flatten([[0, 1, 2], [0, 1, 2, 3, 4], [2, 1, 0]]))
    points, polygons = sample_surface(surface, 1000)
    assert set(polygons.tolist()) == {1}
    assert np.ptp(points[:, 0]) > 1.9
    with pytest.raises(ValueError, match="without area"):
        sample_surface(Surface.from_polygons(vertices, *flatten([[0, 1, 2]])), 10)
