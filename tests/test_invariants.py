import dataclasses
import json

import numpy as np
import pytest
from known_meshes import CUBE_POLYGONS, CUBE_VERTICES, cube, flatten, inverted, joined, sheet, soup_of, torus

from mn_onnx.extract.invariants import check_invariants, mark_box_edges
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld

BOX = [[-1, 1]] * 3


def from_lists(vertices, polygons):
    return Surface.from_polygons(np.asarray(vertices, float), *flatten(polygons))


def test_a_torus_has_no_problems():
    found = check_invariants(weld(soup_of(torus(24, 12))), bounds=BOX)
    assert found.problems() == []
    assert found.notes() == []
    assert (found.closed, found.watertight, found.oriented, found.manifold) == (True, True, True, True)
    assert (found.polygons, found.vertices, found.edges, found.euler) == (288, 288, 576, 0)
    assert [component.genus for component in found.components] == [1]
    assert found.valences == {4: 288}
    assert found.shortest_edge > 0


def test_a_cube_has_valence_three():
    found = check_invariants(cube())
    assert found.valences == {3: 8}
    assert (found.area, found.volume, found.shortest_edge) == pytest.approx((6.0, 1.0, 1.0))


def test_a_surface_that_leaves_the_box_is_closed_but_not_watertight():
    marked = mark_box_edges(sheet(5, 7), BOX)
    found = check_invariants(marked, bounds=BOX)
    assert (found.closed, found.watertight) == (True, False)
    assert (found.boundary_edges, found.unmatched_edges, found.off_box_edges) == (20, 0, 0)
    assert found.valences == {4: 15}
    assert found.volume is None
    assert found.problems() == []
    assert found.notes() == ["the surface leaves the box along 20 edges"]
    assert set(marked.box_faces[marked.boundary]) == {0, 1, 2, 3}


def test_a_boundary_off_the_box_is_a_problem():
    found = check_invariants(mark_box_edges(sheet(5, 7), [[-1.1, 1.1], [-1, 1], [-1, 1]]))
    assert found.unmatched_edges == 2 * 6
    assert not found.closed
    shifted = dataclasses.replace(mark_box_edges(sheet(5, 7), BOX))
    assert check_invariants(shifted, bounds=[[-1.1, 1.1], [-1, 1], [-1, 1]]).off_box_edges == 2 * 6


def test_a_missing_polygon_opens_the_mesh():
    found = check_invariants(from_lists(CUBE_VERTICES, CUBE_POLYGONS[1:]))
    assert found.unmatched_edges == 4
    assert not found.closed
    assert found.manifold
    assert len(found.problems()) == 1


def test_a_turned_polygon_is_misoriented():
    polygons = [CUBE_POLYGONS[0][::-1], *CUBE_POLYGONS[1:]]
    found = check_invariants(from_lists(CUBE_VERTICES, polygons))
    assert (found.misoriented_edges, found.unmatched_edges, found.nonmanifold_edges) == (4, 8, 0)
    assert not found.oriented
    assert found.edges == 12


def test_an_inverted_surface_faces_against_its_gradient():
    surface = torus()
    found = check_invariants(dataclasses.replace(inverted(surface), gradients=surface.gradients))
    assert found.flipped_polygons == surface.n_polygons
    assert not found.oriented
    assert found.closed


def test_two_cubes_that_share_an_edge_are_not_manifold():
    vertices = np.concatenate([CUBE_VERTICES, CUBE_VERTICES + np.array([1.0, 1.0, 0.0])])
    polygons = CUBE_POLYGONS + [[vertex + 8 for vertex in polygon] for polygon in CUBE_POLYGONS]
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    found = check_invariants(from_lists(unique, [[int(index[v]) for v in polygon] for polygon in polygons]))
    assert (found.nonmanifold_edges, found.unmatched_edges) == (1, 4)
    assert found.edges == 23
    assert not found.manifold
    assert len(found.components) == 1
    assert found.components[0].genus is None


def test_two_cubes_that_share_a_vertex_are_not_manifold_there():
    vertices = np.concatenate([CUBE_VERTICES, CUBE_VERTICES + 1.0])
    polygons = CUBE_POLYGONS + [[vertex + 8 for vertex in polygon] for polygon in CUBE_POLYGONS]
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    found = check_invariants(from_lists(unique, [[int(index[v]) for v in polygon] for polygon in polygons]))
    assert (found.nonmanifold_vertices, found.nonmanifold_edges, found.unmatched_edges) == (1, 0, 0)
    assert found.closed
    assert not found.manifold
    assert found.euler == 3


def test_two_fans_at_a_boundary_vertex_are_not_manifold():
    bow_tie = from_lists([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]], [[0, 1, 2], [0, 3, 4]])
    assert check_invariants(bow_tie).nonmanifold_vertices == 1


def test_degenerate_polygons_are_noted():
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 0]]
    found = check_invariants(from_lists(vertices, [[0, 1, 2, 3, 4], [0, 4, 3]]))
    assert found.degenerate_polygons == 1
    assert found.polygons_with_zero_edges == 2
    assert found.shortest_edge == 0.0
    assert len(found.notes()) == 2


def test_disagreeing_corners_are_a_problem():
    soup = soup_of(cube(), noise=1e-3)
    found = check_invariants(weld(soup))
    assert found.position_disagreements == 8
    assert any("corners that lie apart" in problem for problem in found.problems())


def test_unused_vertices_do_not_count_towards_the_euler_number():
    surface = cube()
    loose = dataclasses.replace(surface, vertices=np.concatenate([surface.vertices, [[9.0, 9.0, 9.0]]]))
    found = check_invariants(loose)
    assert found.euler == 2
    assert len(found.components) == 1


def test_as_dict_is_json():
    values = json.loads(json.dumps(check_invariants(joined(cube(), sheet())).as_dict()))
    assert values["components"] == 2
    assert values["component_list"][0]["euler"] == 2
    assert values["component_list"][1]["volume"] is None
    assert values["valences"] == {"3": 8, "4": 15}
    assert values["closed"] is False


def test_malformed_bounds_are_refused():
    with pytest.raises(ValueError, match="three pairs"):
        mark_box_edges(cube(), [[-1, 1]] * 2)
    with pytest.raises(ValueError, match="three pairs"):
        check_invariants(cube(), bounds=[[1, -1]] * 3)
