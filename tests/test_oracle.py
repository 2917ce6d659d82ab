"""The oracle itself: closed forms, dense sampling, and its own conservation laws."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import onnxruntime
import pytest

from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from oracle.level_set import Facet, LevelSet, exact_level_set
from oracle.polytope import Affine, Polytope
from oracle.random_networks import ACTIVATIONS, RandomNetwork, table_values
from oracle.regions import activation_regions
from oracle.sketch import Sketch, affine_row, as_network, as_onnx, evaluate

BOX = ([-1.0] * 3, [1.0] * 3)
MIXED = [
    RandomNetwork(3, (("relu", 6),), False, 1),
    RandomNetwork(3, (("relu", 4), ("leaky_relu", 4)), True, 2),
    RandomNetwork(3, (("clip", 3), ("abs", 3), ("relu", 3)), True, 3),
    RandomNetwork(3, (("maximum", 4), ("minimum", 3)), False, 4),
]


def _polytope_after(planes: list[tuple[tuple[int, ...], Fraction]]) -> Polytope:
    polytope = Polytope.box(*BOX)
    for normal, offset in planes:
        polytope = polytope.split(Affine(tuple(Fraction(a) for a in normal), offset))[1] or polytope
    return polytope


def test_cut_corner_of_a_cube() -> None:
    """x + y + z <= 2 takes a corner of volume 1/6 from the cube [-1, 1]^3 and leaves a triangle there."""
    polytope = _polytope_after([((-1, -1, -1), Fraction(2))])
    assert len(polytope.vertices) == 10
    assert polytope.volume() == 8 - Fraction(1, 6)


def test_octahedron_from_a_cube_is_not_simple_and_exact() -> None:
    """|x| + |y| + |z| <= 1: six vertices with four facets each, volume 4/3."""
    signs = [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    polytope = _polytope_after([(sign, Fraction(1)) for sign in signs])
    corners = {tuple(int(x) for x in vertex.position) for vertex in polytope.vertices}
    assert corners == {(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)}
    assert polytope.volume() == Fraction(4, 3)


def test_split_by_a_supporting_plane_gives_no_second_part() -> None:
    """A plane that only touches the cube, in a corner or in a face, does not split it."""
    cube = Polytope.box(*BOX)
    for normal, offset in [((1, 1, 1), 3), ((1, 0, 0), 1)]:
        below, above = cube.split(Affine(tuple(Fraction(a) for a in normal), Fraction(offset)))
        assert below is None
        assert above is cube


@pytest.mark.parametrize("body", MIXED, ids=str)
def test_regions_tile_the_box(body: RandomNetwork) -> None:
    regions = list(activation_regions(as_network(body), *BOX))
    assert sum(region.polytope.volume() for region in regions) == 8
    states = [region.states for region in regions]
    assert all(first < second for first, second in pairwise(states))


def test_generic_planes_give_the_known_number_of_regions() -> None:
    """n planes in general position have 1 + n + C(n,2) + C(n,3) regions in space; the box is large enough for all."""
    body = RandomNetwork(3, (("relu", 5),), False, 7)
    regions = list(activation_regions(as_network(body), [-4096.0] * 3, [4096.0] * 3))
    assert len(regions) == 1 + 5 + 10 + 10


@pytest.mark.parametrize("body", MIXED, ids=str)
def test_every_sampled_point_lies_in_a_region_with_its_value(body: RandomNetwork) -> None:
    """The affine function of the region around a point is the network there, evaluated without units."""
    regions = list(activation_regions(as_network(body), *BOX))
    points = np.random.default_rng(5).uniform(-1, 1, (40, 3))
    for point, value in zip(points, evaluate(body, points), strict=True):
        exact_point = tuple(Fraction(float(x)) for x in point)
        around = [r for r in regions if all(h(exact_point) >= 0 for h in r.polytope.halfspaces)]
        assert len(around) == 1
        assert float(around[0].value(exact_point)) == pytest.approx(value, abs=1e-14)


@pytest.mark.parametrize("body", MIXED, ids=str)
def test_facets_are_all_sign_changes_along_random_lines(body: RandomNetwork) -> None:
    """Bisection finds where the network changes its sign along dense lines; a facet of the oracle is at every place."""
    body = body.centred()
    exact = exact_level_set(as_network(body), *BOX)
    rng = np.random.default_rng(11)
    crossings = np.concatenate([_sign_changes(body, *rng.uniform(-1, 1, (2, 3))) for _ in range(60)])
    assert len(crossings) > 20
    distances = np.min([_distances_to_polygon(facet, crossings) for facet in exact.facets], axis=0)
    assert distances.max() < 1e-9


def _sign_changes(body: RandomNetwork, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    steps = np.linspace(0, 1, 400)
    values = evaluate(body, start + steps[:, None] * (end - start))
    changes = np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))
    low, high = steps[changes], steps[changes + 1]
    for _ in range(60):
        middle = (low + high) / 2
        same = np.sign(evaluate(body, start + middle[:, None] * (end - start))) == np.sign(values[changes])
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return start + high[:, None] * (end - start)


def _distances_to_polygon(facet: Facet, points: np.ndarray) -> np.ndarray:
    """How far ``points`` are outside the convex polygon: the largest distance beyond its plane or one of its sides."""
    corners = np.array([[float(x) for x in vertex] for vertex in facet.vertices])
    normal = np.array([float(x) for x in facet.gradient])
    normal /= np.linalg.norm(normal)
    outside = [np.abs((points - corners[0]) @ normal)]
    for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        outward = np.cross(second - first, normal)
        outside.append((points - first) @ (outward / np.linalg.norm(outward)))
    return np.max(outside, axis=0)


@pytest.mark.parametrize("body", MIXED, ids=str)
def test_surface_is_closed_and_general(body: RandomNetwork) -> None:
    """Edges cancel inside the box, and four polygons meet at every inner vertex."""
    exact = exact_level_set(as_network(body.centred()), *BOX)
    assert exact.facets
    assert all(exact.box_faces(edge) for edge in exact.boundary_edges)
    inner = [count for vertex, count in exact.valences.items() if not exact.box_faces([vertex])]
    assert inner
    assert set(inner) == {4}


def _octahedron() -> LevelSet:
    def body(sketch: Sketch[Any], x: Any) -> Any:
        return sketch.affine(sketch.abs(x), [[1, 1, 1]], [-0.5])

    return exact_level_set(as_network(body), *BOX)


def test_octahedron() -> None:
    exact = _octahedron()
    assert (len(exact.facets), len(exact.vertices), exact.n_edges, exact.euler) == (8, 6, 12, 2)
    assert exact.enclosed_volume == exact.inner_volume == Fraction(1, 6)
    assert exact.area == pytest.approx(np.sqrt(3.0), abs=1e-15)
    assert len(exact.components) == 1
    assert exact.boundary_edges == ()
    assert all(min(facet.vertices) == facet.vertices[0] for facet in exact.facets)


def test_facet_on_a_knot_plane_counts_once_and_from_the_negative_side() -> None:
    """relu(x) - relu(-x) / 2 vanishes on the knot plane x = 0 itself."""
    below = AffineRow(np.array([0]), np.array([-1.0]), 0.0)
    above = AffineRow(np.array([0]), np.array([1.0]), 0.0)
    table = KnotTable.exact([0.0], [[0.0, 1.0]], [[0.0, 0.0]])
    units = (Unit(above, (table,), "above", table), Unit(below, (table,), "below", table))
    exact = exact_level_set(Network(3, units, affine_row([0, 0, 0, 1.0, -0.5], 0.0)), *BOX)
    assert len(exact.facets) == 1
    assert exact.facets[0].gradient == (Fraction(1, 2), 0, 0)
    assert exact.inner_volume == 4


def test_flat_region_is_reported() -> None:
    """relu(x) is zero in half of the box and negative nowhere: no facet, one flat region."""
    body = as_network(lambda sketch, x: sketch.relu(sketch.affine(x, [[1, 0, 0]], [0])))
    exact = exact_level_set(body, *BOX)
    assert exact.facets == ()
    assert exact.flat_regions == ((0,),)


def test_circle_like_polyline_and_roots() -> None:
    """|x| + |y| = 1/2 has four segments of length sqrt(1/2) around the origin; |x| = 1/2 has two roots."""

    def body(dimension: int) -> Network:
        return as_network(lambda s, x: s.affine(s.abs(x), np.ones((1, dimension)), [-0.5]), dimension)

    diamond = exact_level_set(body(2), [-1.0] * 2, [1.0] * 2)
    assert (len(diamond.facets), len(diamond.vertices)) == (4, 4)
    assert diamond.length == pytest.approx(np.sqrt(8.0), abs=1e-15)
    assert len(diamond.components) == 1
    assert {start for start, _ in (f.vertices for f in diamond.facets)} == set(diamond.vertices)
    roots = exact_level_set(body(1), [-1.0], [1.0])
    assert roots.vertices == ((Fraction(-1, 2),), (Fraction(1, 2),))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_units_and_model_of_a_sketch_are_the_same_function(activation: str) -> None:
    """ONNX Runtime, in float32, agrees with the values, and so do the units of the network."""
    body = RandomNetwork(3, ((activation, 4), ("relu", 3)), True, 9)
    points = np.random.default_rng(2).uniform(-1, 1, (200, 3)).astype(np.float32)
    session = onnxruntime.InferenceSession(as_onnx(body).SerializeToString(), providers=["CPUExecutionProvider"])
    values = evaluate(body, points)
    np.testing.assert_allclose(session.run(None, {"x": points})[0][:, 0], values, atol=2e-6)
    np.testing.assert_allclose(table_values(as_network(body), points), values, atol=1e-13)
