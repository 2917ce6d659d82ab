"""Contraction of coinciding vertices, removal of flat polygons and of copies of box faces, and the limit of meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_meshes import cube, flatten, joined, sheet, soup_of, torus

from mn_onnx.extract.degeneracy.box_copies import drop_box_copies
from mn_onnx.extract.degeneracy.contract import contract_short_edges
from mn_onnx.extract.degeneracy.limit import limit_surface
from mn_onnx.extract.invariants import check_invariants, mark_box_edges
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld

LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
BOUNDS = [[-1, 1]] * 3


def assert_clean(surface: Surface) -> None:
    found = check_invariants(surface)
    assert found.problems() == []
    assert found.degenerate_polygons == found.polygons_with_zero_edges == 0
    rebuilt = Surface.from_polygons(surface.vertices, surface.offsets, surface.corners)
    np.testing.assert_array_equal(surface.twins, rebuilt.twins)


def test_nothing_short_changes_nothing() -> None:
    before = torus()
    surface, contraction = contract_short_edges(before, 1e-9)
    assert (contraction.merged_vertices, contraction.removed_polygons) == (0, 0)
    for name in ("offsets", "twins", "gradients"):
        np.testing.assert_array_equal(getattr(surface, name), getattr(before, name))
    np.testing.assert_array_equal(surface.vertices[surface.corners], before.vertices[before.corners])


def test_a_tetrahedron_without_height_vanishes() -> None:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0]]
    flat = Surface.from_polygons(vertices, *flatten([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    surface, _ = contract_short_edges(flat, 1e-9)
    assert surface.n_polygons == 4  # each of its faces has an area: a pillow is a surface of its own
    vertices[2] = [0.5, 0, 0]
    vertices[3] = [0.25, 0, 0]
    needle = Surface.from_polygons(vertices, *flatten([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    surface, contraction = contract_short_edges(needle, 1e-9)
    assert surface.n_polygons == surface.n_vertices == 0
    assert contraction.removed_polygons == 4


@pytest.mark.parametrize("offset", [0.0, 1e-12])
def test_a_triangle_whose_tip_is_on_its_base_gives_the_tip_to_the_polygon_across(offset: float) -> None:
    """The face z = 1/2 of a cube in three parts: two halves, and between them a triangle of no width."""
    whole = cube()
    vertices = np.concatenate([whole.vertices, [[0.1, offset, 0.5]]])
    below, above = [1, 5, 7, 3], 8
    tops = [[below[0], below[1], above, below[3]], [below[1], below[2], above], [below[2], below[3], above]]
    vertices[above] = 0.5 * (vertices[5] + vertices[3]) + [offset, offset, 0]
    others = [list(part) for part in np.split(whole.corners, whole.offsets[1:-1])][:-1]
    surface = Surface.from_polygons(vertices, *flatten([*others, [1, 5, 3], [5, above, 3], tops[1], tops[2]]))
    assert check_invariants(surface).closed
    cleaned, contraction = contract_short_edges(surface, 1e-11)
    assert contraction.removed_polygons == 1
    assert contraction.merged_vertices == 0
    assert_clean(cleaned)
    found = check_invariants(cleaned)
    assert found.volume == pytest.approx(1)
    assert sorted(cleaned.polygon_sizes) == [3, 3, 4, 4, 4, 4, 4, 4]


def test_a_handle_without_width_is_cut() -> None:
    """A torus whose tube is one point at one place: as a set of points a sphere that touches itself there."""
    before = torus(12, 6)
    vertices = before.vertices.copy()
    vertices[:6] = vertices[:6].mean(axis=0)
    pinched = Surface.from_polygons(vertices, before.offsets, before.corners)
    surface, contraction = contract_short_edges(pinched, 0.0)
    assert_clean(surface)
    assert contraction.merged_vertices == 5
    assert contraction.removed_polygons == 0
    (component,) = surface.components
    assert component.genus == 0
    assert surface.n_vertices == before.n_vertices - 4  # the point has a vertex for each side


@pytest.mark.parametrize("seed", range(8))
def test_pulled_meshes_stay_closed_manifolds(seed: int) -> None:
    before = joined(torus(12, 6), cube(0.3))
    generator = np.random.default_rng(seed)
    vertices = before.vertices.copy()
    following = np.arange(before.n_corners) + 1
    following[before.offsets[1:] - 1] = before.offsets[:-1]
    for corner in generator.choice(before.n_corners, (5 + 10 * seed), replace=False):
        vertices[before.corners[corner]] = vertices[before.corners[following[corner]]]
    pulled = Surface.from_polygons(vertices, before.offsets, before.corners)
    surface, contraction = contract_short_edges(pulled, 0.0)
    found = check_invariants(surface)
    assert contraction.merged_vertices > 0
    assert found.unmatched_edges == found.misoriented_edges == found.nonmanifold_vertices == 0
    assert found.degenerate_polygons == found.polygons_with_zero_edges == 0
    assert found.volume == pytest.approx(pulled.volume)
    assert found.area == pytest.approx(pulled.area)


def test_a_slit_without_width_is_closed() -> None:
    """Two sheets that end on the box along the same line."""
    vertices = [
        [-1, -1, 0],
        [-1, 1, 0],
        [0, 1, 0.5],
        [0, -1, 0.5],
        [-1, 1, 1e-13],
        [-1, -1, 1e-13],
        [0, -1, 1],
        [0, 1, 1],
    ]
    sheets = Surface.from_polygons(vertices, *flatten([[0, 3, 2, 1], [4, 7, 6, 5], [0, 1, 4, 5]]))
    sheets = mark_box_edges(sheets, BOUNDS)
    surface, contraction = contract_short_edges(sheets, 1e-12)
    assert contraction.removed_polygons == 1
    assert surface.n_polygons == 2
    assert np.count_nonzero(surface.twins >= 0) == 2
    slit = replace(sheets, twins=np.where(sheets.twins < 0, -1, sheets.twins))
    open_slit = Surface.from_polygons(slit.vertices, slit.offsets[:3], slit.corners[: slit.offsets[2]])
    closed, _ = contract_short_edges(mark_box_edges(_merged(open_slit), BOUNDS), 1e-12)
    assert np.count_nonzero(closed.twins >= 0) == 2


def _merged(surface: Surface) -> Surface:
    """The two sheets with their common line made of the same vertices, but not joined along it."""
    corners = surface.corners.copy()
    corners[corners == 4], corners[corners == 5] = 1, 0
    return replace(surface, corners=corners)


def test_copies_of_box_faces_are_left_out() -> None:
    surface, n_dropped = drop_box_copies(cube(2.0), LOWER, UPPER, 1e-12)
    assert (surface.n_polygons, n_dropped) == (0, 6)
    low = cube(1.0, (0.0, 0.0, -0.5))
    surface, n_dropped = drop_box_copies(low, LOWER, UPPER, 1e-12)
    found = check_invariants(surface, bounds=BOUNDS)
    assert n_dropped == 1
    assert (found.polygons, found.boundary_edges) == (5, 4)
    assert found.problems() == []
    assert set(surface.box_faces[surface.boundary]) == {4}


def test_a_surface_that_only_ends_on_the_box_stays() -> None:
    before = mark_box_edges(sheet(), BOUNDS)
    surface, n_dropped = drop_box_copies(before, LOWER, UPPER, 1e-12)
    assert surface is before
    assert n_dropped == 0


def test_the_limit_is_where_two_scales_point() -> None:
    start, direction = torus(6, 5), np.random.default_rng(0).normal(size=(30, 3))
    soups = tuple(soup_of(replace(start, vertices=start.vertices + scale * 1e-6 * direction)) for scale in (1.0, 0.5))
    surfaces = tuple(weld(soup) for soup in soups)
    found = limit_surface(soups, surfaces)
    assert found is not None
    surface, displacement = found
    np.testing.assert_allclose(np.sort(surface.vertices, axis=0), np.sort(start.vertices, axis=0), atol=1e-15)
    assert displacement == pytest.approx(0.5e-6 * np.sqrt((direction**2).sum(axis=1)).max())


def test_meshes_of_other_vertices_or_polygons_have_no_limit() -> None:
    soup = soup_of(torus(6, 5))
    other_vertices = soup_of(torus(6, 5), seed=1)
    two_quads, one_less = soup_of(cube()), soup_of(cube())
    offsets = one_less.offsets[:-1]
    one_less = replace(
        one_less,
        offsets=offsets,
        **{name: getattr(one_less, name)[: offsets[-1]] for name in ("corners", "positions", "keys", "box_faces")},
        **{name: getattr(one_less, name)[:-1] for name in ("gradients", "errors")},
    )
    for one, other in ((soup, other_vertices), (two_quads, one_less)):
        assert limit_surface((one, other), (weld(one), weld(other))) is None
