import numpy as np
import pytest
from known_meshes import CUBE_POLYGONS, CUBE_VERTICES, cube, flatten, inverted, joined, sheet, torus

from mn_onnx.extract.surface import Surface


def triangle_areas(surface):
    a, b, c = np.moveaxis(surface.vertices[surface.triangles()], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def test_cube_counts_and_measures():
    surface = cube(2.0, (3.0, -1.0, 0.5))
    assert (surface.n_vertices, surface.n_edges, surface.n_polygons, surface.n_corners) == (8, 12, 6, 24)
    assert surface.area == pytest.approx(24.0, rel=1e-14)
    assert surface.volume == pytest.approx(8.0, rel=1e-14)
    np.testing.assert_array_equal(np.abs(surface.normals).sum(axis=1), np.ones(6))


def test_twins_run_along_the_same_edge():
    surface = torus()
    heads = surface.corners[surface.twins]
    following = np.arange(surface.n_corners) + 1
    following[surface.offsets[1:] - 1] = surface.offsets[:-1]
    np.testing.assert_array_equal(heads, surface.corners[following])


def test_components_carry_their_own_topology_and_measures():
    ring = torus(48, 32)
    shell = joined(cube(2.0), inverted(cube(1.0)), ring, sheet(4, 4))
    outer, cavity, tube, plane = shell.components
    assert (outer.volume, outer.area, outer.euler, outer.genus) == pytest.approx((8.0, 24.0, 2, 0))
    assert (cavity.volume, cavity.area, cavity.euler, cavity.genus) == pytest.approx((-1.0, 6.0, 2, 0))
    assert (tube.euler, tube.genus, tube.closed) == (0, 1, True)
    assert tube.volume == pytest.approx(ring.volume)
    assert tube.volume == pytest.approx(2 * np.pi**2 * 0.6 * 0.2**2, rel=0.02)
    assert (plane.closed, plane.volume, plane.boundary_loops, plane.genus, plane.euler) == (False, None, 1, 0, 1)
    assert plane.area == pytest.approx(4.0)
    assert shell.volume is None


def test_two_boundary_loops_of_a_tube():
    columns, rows = 9, 4
    angle = 2 * np.pi * np.arange(columns) / columns
    rings = [np.stack([np.cos(angle), np.sin(angle), np.full(columns, z)], axis=1) for z in range(rows)]
    quads = [
        [i * columns + j, i * columns + (j + 1) % columns, (i + 1) * columns + (j + 1) % columns, (i + 1) * columns + j]
        for i in range(rows - 1)
        for j in range(columns)
    ]
    (tube,) = Surface.from_polygons(np.concatenate(rings), *flatten(quads)).components
    assert (tube.boundary_loops, tube.euler, tube.genus) == (2, 0, 0)


def test_triangles_cover_the_polygons():
    surface = torus()
    assert len(surface.triangles()) == surface.n_corners - 2 * surface.n_polygons
    assert triangle_areas(surface).sum() == pytest.approx(surface.area, rel=1e-3)
    np.testing.assert_array_equal(surface.triangle_polygons(), np.repeat(np.arange(surface.n_polygons), 2))
    flat = cube()
    a, b, c = np.moveaxis(flat.vertices[flat.triangles()], 1, 0)
    np.testing.assert_array_equal(np.cross(b - a, c - a), flat.normals[flat.triangle_polygons()])


@pytest.mark.parametrize("start", range(5))
def test_fans_avoid_collinear_corners(start):
    """A square with a fifth corner in the middle of a side: only some apices give triangles with area."""
    square = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    surface = Surface.from_polygons(np.roll(square, start, axis=0), [0, 5], np.arange(5))
    areas = triangle_areas(surface)
    assert areas.min() > 0.5
    assert areas.sum() == pytest.approx(4.0)


def test_to_trimesh_is_watertight_with_our_normals():
    surface = torus()
    mesh = surface.to_trimesh()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 0
    assert mesh.vertices.shape == surface.vertices.shape
    np.testing.assert_array_equal(mesh.face_normals, surface.normals[surface.triangle_polygons()])


def test_zero_gradient_has_zero_normal():
    surface = Surface.from_polygons([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [0, 3], [0, 1, 2])
    np.testing.assert_array_equal(surface.normals, np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": CUBE_VERTICES[:, :2]}, r"vertices have shape \(8, 2\)"),
        ({"vertices": CUBE_VERTICES[:7]}, "name vertices|vertices"),
        ({"offsets": [0, 2, 24]}, "at least 3"),
        ({"offsets": [0, 4, 8]}, "expected 8 integers"),
        ({"corners": np.zeros(24)}, "expected 24 integers"),
    ],
)
def test_malformed_polygons_are_refused(change, message):
    offsets, corners = flatten(CUBE_POLYGONS)
    arguments = {"vertices": CUBE_VERTICES, "offsets": offsets, "corners": corners, **change}
    with pytest.raises(ValueError, match=message):
        Surface.from_polygons(**arguments)


def test_centres_are_the_means_of_corners():
    surface = joined(cube(2.0, (3.0, -1.0, 0.5)), torus())
    chosen = np.array([5, 0, surface.n_polygons - 1])
    expected = [
        surface.vertices[surface.corners[begin:end]].mean(axis=0)
        for begin, end in zip(surface.offsets[chosen], surface.offsets[chosen + 1], strict=True)
    ]
    np.testing.assert_allclose(surface.centres(chosen), expected, rtol=1e-14)
    assert surface.centres(np.zeros(0, np.int64)).shape == (0, 3)
