import numpy as np
import pytest
from known_meshes import CUBE_POLYGONS, CUBE_VERTICES, cube, flatten, joined, sheet, torus

from mn_onnx.extract.degenerate import collapse_short_edges, merge_zero_length_edges
from mn_onnx.extract.invariants import check_invariants, mark_box_edges
from mn_onnx.extract.surface import Surface

BOX = [[-1, 1]] * 3


def chamfered_cube(width):
    """The unit cube with a rectangle along each edge and a triangle at each corner, all of that ``width``."""
    points: dict[tuple[float, ...], int] = {}

    def vertex(axis, signs):
        inner = [sign * (0.5 if other == axis else 0.5 - width) for other, sign in enumerate(signs)]
        return points.setdefault((axis, *np.sign(inner)), len(points))

    polygons = []
    signs = (-1.0, 1.0)
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for side in signs:
            corners = []
            for a, b in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)):
                corner = [0.0] * 3
                corner[axis], corner[first], corner[second] = side, a, b
                corners.append(vertex(axis, corner))
            polygons.append(corners if side > 0 else corners[::-1])
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for a in signs:
            for b in signs:
                ends = []
                for side, wall in ((-1.0, first), (1.0, first), (1.0, second), (-1.0, second)):
                    corner = [0.0] * 3
                    corner[axis], corner[first], corner[second] = side, a, b
                    ends.append(vertex(wall, corner))
                polygons.append(ends if a * b < 0 else ends[::-1])
    for a in signs:
        for b in signs:
            for c in signs:
                corners = [vertex(axis, (a, b, c)) for axis in range(3)]
                polygons.append(corners if a * b * c > 0 else corners[::-1])
    vertices = np.zeros((24, 3))
    for (axis, *corner), index in points.items():
        vertices[index] = np.array(corner) * (0.5 - width)
        vertices[index, int(axis)] = corner[int(axis)] * 0.5
    return Surface.from_polygons(vertices, *flatten(polygons))


def test_the_chamfered_cube_is_a_generic_mesh():
    found = check_invariants(chamfered_cube(0.1))
    assert (found.polygons, found.vertices, found.edges) == (26, 24, 48)
    assert found.valences == {4: 24}
    assert found.problems() == []
    assert found.volume > 0


@pytest.mark.parametrize("width", [1e-9, 0.0])
def test_chamfers_collapse_to_a_cube(width):
    surface, clean_up = collapse_short_edges(chamfered_cube(width), 10 * width)
    found = check_invariants(surface)
    assert found.problems() == []
    assert found.notes() == []
    assert (found.polygons, found.vertices, found.edges) == (6, 8, 12)
    assert found.volume == pytest.approx(1.0, abs=10 * width + 1e-15)
    assert (clean_up.removed_polygons, clean_up.refused_edges) == (20, 0)
    assert clean_up.collapsed_edges == 16
    assert clean_up.largest_displacement <= np.sqrt(2) * width * (1 + 1e-6)
    assert surface.report["clean_up"]["removed_polygons"] == 20


def test_nothing_short_changes_nothing():
    before = torus()
    surface, clean_up = collapse_short_edges(before, 1e-6)
    assert surface is before
    assert (clean_up.collapsed_edges, clean_up.refused_edges, clean_up.removed_polygons) == (0, 0, 0)


def test_data_of_the_remaining_polygons_stay_with_them():
    before = chamfered_cube(1e-9)
    before = Surface(
        **{**vars(before), "attributes": {"number": np.arange(26)}, "errors": np.arange(26.0)},
    )
    surface, _ = collapse_short_edges(before, 1e-8)
    np.testing.assert_array_equal(surface.attributes["number"], np.arange(6))
    np.testing.assert_array_equal(surface.errors, np.arange(6.0))
    np.testing.assert_array_equal(surface.gradients, before.gradients[:6])


def random_short_edges(surface, fraction, seed):
    """The surface with many vertices pulled onto a neighbour."""
    generator = np.random.default_rng(seed)
    vertices = surface.vertices.copy()
    following = np.arange(surface.n_corners) + 1
    following[surface.offsets[1:] - 1] = surface.offsets[:-1]
    for corner in generator.choice(surface.n_corners, int(fraction * surface.n_corners), replace=False):
        vertices[surface.corners[corner]] = vertices[surface.corners[following[corner]]]
    return Surface.from_polygons(vertices, surface.offsets, surface.corners)


@pytest.mark.parametrize("seed", range(12))
def test_collapses_never_change_the_topology(seed):
    before = random_short_edges(joined(torus(12, 6), cube(0.3), sheet(6, 6)), 0.1 + 0.03 * seed, seed)
    surface, clean_up = collapse_short_edges(before)
    old, new = check_invariants(before), check_invariants(surface)
    assert clean_up.collapsed_edges > 0
    assert new.nonmanifold_edges == new.nonmanifold_vertices == new.misoriented_edges == 0
    assert [component.euler for component in new.components] == [component.euler for component in old.components]
    assert [component.genus for component in new.components] == [1, 0, 0]
    assert [component.boundary_loops for component in new.components] == [0, 0, 1]
    if not clean_up.refused_edges:
        assert new.polygons_with_zero_edges == 0
    rebuilt = Surface.from_polygons(surface.vertices, surface.offsets, surface.corners)
    np.testing.assert_array_equal(surface.twins, rebuilt.twins)
    assert surface.area == pytest.approx(before.area)


def test_a_thin_ring_is_not_pinched():
    """A torus whose tube has length zero around at one place: closing it would cut the handle."""
    before = torus(12, 6)
    vertices = before.vertices.copy()
    vertices[:6] = vertices[:6].mean(axis=0)
    pinched = Surface.from_polygons(vertices, before.offsets, before.corners)
    surface, clean_up = collapse_short_edges(pinched)
    found = check_invariants(surface)
    assert clean_up.refused_edges == 3
    assert found.components[0].genus == 1
    assert found.manifold
    assert found.closed


def test_a_tetrahedron_does_not_become_a_pillow():
    vertices = [[0, 0, 0], [1e-9, 0, 0], [0, 1, 0], [0, 0, 1]]
    tetrahedron = Surface.from_polygons(vertices, *flatten([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    surface, clean_up = collapse_short_edges(tetrahedron, 1e-6)
    assert surface is tetrahedron
    assert clean_up.refused_edges == 1


def test_vertices_on_the_box_stay_on_their_faces():
    flat = sheet(7, 7)
    vertices = flat.vertices.copy()
    vertices[1, 1] = -1.0  # beside a corner of the box, along its edge
    vertices[3 * 7 + 1] = vertices[3 * 7]  # an inner vertex onto the boundary
    vertices[6 * 7 + 3, 1] = vertices[6 * 7 + 2, 1]  # two within one box face
    pulled = mark_box_edges(Surface.from_polygons(vertices, flat.offsets, flat.corners), BOX)
    surface, clean_up = collapse_short_edges(pulled)
    found = check_invariants(surface, bounds=BOX)
    assert clean_up.collapsed_edges == 3
    assert found.problems() == []
    assert found.area == pytest.approx(4.0)
    assert found.boundary_edges == 24 - 2
    assert found.polygons_with_zero_edges == 0


def test_an_edge_across_the_box_is_refused():
    """A strip without width: its inner rungs join two boundaries, only those at its ends may go."""
    vertices = [[x, y, 0] for x in np.linspace(0, 1, 4) for y in (-1e-9, 1e-9)]
    strip = Surface.from_polygons(vertices, *flatten([[2 * i, 2 * i + 2, 2 * i + 3, 2 * i + 1] for i in range(3)]))
    surface, clean_up = collapse_short_edges(strip, 1e-6)
    assert surface.n_polygons == 3
    assert (clean_up.collapsed_edges, clean_up.refused_edges) == (2, 2)


@pytest.mark.parametrize("length", [-1.0, np.nan])
def test_senseless_lengths_are_refused(length):
    with pytest.raises(ValueError, match="at least 0"):
        collapse_short_edges(cube(), length)


def test_merging_closes_a_mesh_torn_at_one_point():
    """A corner of the cube as two vertices at one place, joined by an edge that only one polygon has."""
    vertices = np.concatenate([CUBE_VERTICES, CUBE_VERTICES[:1]])
    polygons = [[0, 8, 1, 3, 2], [4, 6, 7, 5], [8, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    torn = Surface.from_polygons(vertices, *flatten(polygons))
    assert not check_invariants(torn).closed
    surface, clean_up = merge_zero_length_edges(torn)
    found = check_invariants(surface)
    assert found.problems() == []
    assert (found.polygons, found.vertices, found.edges) == (6, 8, 12)
    assert (clean_up.collapsed_edges, clean_up.removed_polygons, clean_up.largest_displacement) == (1, 0, 0.0)


def test_merging_drops_polygons_without_three_corners():
    surface, clean_up = merge_zero_length_edges(chamfered_cube(0.0))
    found = check_invariants(surface)
    assert (found.polygons, found.vertices, found.edges) == (6, 8, 12)
    assert found.problems() == []
    assert clean_up.removed_polygons == 20
    for mine, cubes in zip(np.split(surface.corners, surface.offsets[1:-1]), CUBE_POLYGONS, strict=True):
        assert len(mine) == len(cubes)


def test_merging_a_mesh_without_polygons():
    empty = Surface.from_polygons(np.zeros((0, 3)), [0], np.zeros(0, int))
    surface, clean_up = merge_zero_length_edges(empty)
    assert surface.n_polygons == clean_up.collapsed_edges == 0
    assert collapse_short_edges(empty)[0] is empty
