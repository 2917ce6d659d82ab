import dataclasses
import time

import numpy as np
import pytest
from known_meshes import cube, joined, sheet, soup_of, torus

from mn_onnx.extract.edges import pair_half_edges
from mn_onnx.extract.invariants import mark_box_edges
from mn_onnx.extract.weld import weld


def naive_weld(soup):
    """Vertex of each corner and twins with dictionaries, as the definitions read."""
    numbers: dict[tuple[int, int], int] = {}
    corners = [numbers.setdefault((int(low), int(high)), len(numbers)) for low, high in soup.corner_keys]
    half_edges: dict[frozenset[int], list[tuple[int, int, int]]] = {}
    for polygon in range(soup.offsets.size - 1):
        begin, end = soup.offsets[polygon : polygon + 2]
        for corner in range(begin, end):
            head = corners[corner + 1 if corner + 1 < end else begin]
            half_edges.setdefault(frozenset({corners[corner], head}), []).append((corner, corners[corner], polygon))
    twins = np.full(len(corners), -1)
    for members in half_edges.values():
        if len(members) == 2:
            (a, tail_a, polygon_a), (b, tail_b, polygon_b) = members
            if tail_a != tail_b and polygon_a != polygon_b:
                twins[a], twins[b] = b, a
    return np.array(corners), twins


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("make", [cube, torus, sheet, lambda: joined(torus(), cube(0.2), sheet(30, 4))])
def test_agrees_with_dictionaries(make, seed):
    soup = soup_of(make(), seed)
    surface = weld(soup)
    corners, twins = naive_weld(soup)
    np.testing.assert_array_equal(surface.corners, corners)
    np.testing.assert_array_equal(surface.twins, twins)
    np.testing.assert_array_equal(surface.vertices[surface.corners], soup.corner_positions)


@pytest.mark.parametrize("n_vertices", [25, 250])
def test_random_polygons_agree_with_dictionaries(n_vertices):
    """Few vertices of many half-edges, or many of few: every kind of broken edge occurs."""
    generator = np.random.default_rng(5)
    sizes = generator.integers(3, 7, 400)
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    vertices = generator.integers(0, n_vertices, offsets[-1])
    # Many polygons run along an edge there and back, and some have a twin that does so the other way.
    for polygon in range(0, 400, 3):
        begin = offsets[polygon]
        vertices[begin + 2] = vertices[begin]
    for polygon in range(1, 400, 3):
        begin, end = offsets[polygon : polygon + 2]
        vertices[end : end + 3] = vertices[begin : begin + 3][::-1]
    soup = dataclasses.replace(
        soup_of(cube()),
        offsets=offsets,
        corners=np.arange(vertices.size),
        positions=generator.normal(size=(n_vertices, 3))[vertices],
        keys=np.stack([vertices, np.full_like(vertices, 7)], axis=1).astype(np.uint64),
        box_faces=np.full(vertices.size, -1, np.int8),
        gradients=np.ones((400, 3)),
        errors=np.zeros(400),
    )
    corners, twins = naive_weld(soup)
    surface = weld(soup)
    np.testing.assert_array_equal(surface.corners, corners)
    np.testing.assert_array_equal(surface.twins, twins)
    assert (twins >= 0).any()
    assert (twins < 0).any()


def test_same_bytes_for_any_number_of_threads():
    soup = soup_of(torus(300, 150), noise=1e-13)
    reference = weld(soup, threads=1)
    for threads in (2, 4):
        surface = weld(soup, threads=threads)
        for name in ("vertices", "corners", "twins"):
            assert getattr(surface, name).tobytes() == getattr(reference, name).tobytes()
        assert surface.report == reference.report


def test_vertices_are_numbered_and_placed_by_their_first_corner():
    soup = soup_of(torus(), noise=1e-12)
    surface = weld(soup)
    _, first_corners = np.unique(surface.corners, return_index=True)
    assert (np.diff(first_corners) > 0).all()
    np.testing.assert_array_equal(surface.vertices, soup.corner_positions[first_corners])


def test_keys_that_differ_in_one_word_are_different_vertices():
    soup = soup_of(cube())
    for word in (0, 1):
        keys = soup.keys.copy()
        keys[:, word] = 0
        assert weld(dataclasses.replace(soup, keys=keys)).n_vertices == 8
    assert weld(dataclasses.replace(soup, keys=np.zeros_like(soup.keys))).n_vertices == 1


def test_colliding_keys_are_reported():
    soup = soup_of(joined(cube(), cube(center=(5.0, 0.0, 0.0))))
    first, other = soup.keys[0].copy(), np.argmax(np.abs(soup.positions - soup.positions[0]).max(axis=1))
    keys = soup.keys.copy()
    keys[(keys == soup.keys[other]).all(axis=1)] = first
    report = weld(dataclasses.replace(soup, keys=keys)).report
    assert report["position_disagreements"] == 1
    assert report["max_position_disagreement"] >= 4.0


def test_rounding_is_no_disagreement():
    report = weld(soup_of(torus(), noise=1e-12)).report
    assert report == {"position_disagreements": 0, "max_position_disagreement": 0.0}


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_corners_may_share_points(dtype):
    """The same mesh, however many of a vertex's corners are at one point; the vertex lies at the first one."""
    apart = soup_of(torus(), noise=1e-12)
    share = np.random.default_rng(8).uniform(size=apart.corners.size) < 0.7
    first_of_key: dict[tuple[int, int], int] = {}
    points, corners = [], []
    for corner, (low, high) in enumerate(apart.keys):
        key = int(low), int(high)
        if key not in first_of_key or not share[corner]:
            first_of_key[key] = len(points)
            points.append(corner)
        corners.append(first_of_key[key])
    soup = dataclasses.replace(
        apart, corners=np.array(corners, dtype), positions=apart.positions[points], keys=apart.keys[points]
    )
    surface, expected = weld(soup), weld(apart)
    assert expected.n_vertices < len(points) < apart.corners.size
    for name in ("vertices", "corners", "twins"):
        np.testing.assert_array_equal(getattr(surface, name), getattr(expected, name))


def test_not_a_number_disagrees():
    soup = soup_of(cube())
    soup.positions[5, 1] = np.nan
    assert weld(soup).report["position_disagreements"] >= 1


def test_missing_polygon_leaves_unmatched_edges():
    surface = cube()
    soup = soup_of(surface)
    kept = {
        "offsets": soup.offsets[:-1],
        "corners": soup.corners[:-4],
        "positions": soup.positions[:-4],
        "keys": soup.keys[:-4],
        "box_faces": soup.box_faces[:-4],
        "gradients": soup.gradients[:-1],
        "errors": soup.errors[:-1],
    }
    opened = weld(dataclasses.replace(soup, **kept))
    assert opened.unmatched.size == 4
    assert opened.boundary.size == 0


def test_edges_on_the_box_are_boundary():
    surface = weld(soup_of(mark_box_edges(sheet(5, 7), [[-1, 1]] * 3)))
    assert surface.unmatched.size == 0
    assert surface.boundary.size == 2 * (4 + 6)


def test_empty_soup():
    surface = weld(
        dataclasses.replace(
            soup_of(cube()),
            offsets=np.zeros(1, np.int64),
            corners=np.zeros(0, np.int32),
            positions=np.zeros((0, 3)),
            keys=np.zeros((0, 2), np.uint64),
            box_faces=np.zeros(0, np.int8),
            gradients=np.zeros((0, 3)),
            errors=np.zeros(0),
        )
    )
    assert (surface.n_polygons, surface.n_vertices, surface.n_edges) == (0, 0, 0)
    assert surface.components == ()


def test_malformed_soup_is_refused_with_all_reasons():
    soup = soup_of(cube())
    with pytest.raises(ValueError, match=r"keys is uint64\[23, 2\].*errors is float32"):
        weld(dataclasses.replace(soup, keys=soup.keys[:-1], errors=soup.errors.astype(np.float32)))
    with pytest.raises(ValueError, match="numbers of points, below 24"):
        weld(dataclasses.replace(soup, corners=soup.corners + 1))
    with pytest.raises(ValueError, match="at least 3"):
        weld(dataclasses.replace(soup, offsets=np.array([0, 2, 24])))


@pytest.mark.parametrize("apices", [(0, 1), (100_000, 100_001)])
def test_a_vertex_of_huge_valence_is_paired_in_the_time_of_sorting(apices):
    """A bipyramid: both apices have as many polygons as there are rim vertices; they come first or last."""
    n = 100_000
    rim = np.arange(n) + (2 if apices[0] == 0 else 0)
    following = np.roll(rim, -1)
    upper = np.stack([rim, following, np.full(n, apices[0])], axis=1)
    lower = np.stack([following, rim, np.full(n, apices[1])], axis=1)
    corners = np.concatenate([upper, lower]).reshape(-1).astype(np.int32)
    offsets = np.arange(2 * n + 1) * 3
    pair_half_edges(offsets[:3], corners[:6], n + 2, 1)
    began = time.perf_counter()
    twins = pair_half_edges(offsets, corners, n + 2, 1)
    assert time.perf_counter() - began < 2.0
    assert (twins >= 0).all()
    np.testing.assert_array_equal(twins[twins], np.arange(corners.size))


def test_64_bit_indices_give_the_same_pairs():
    surface = torus()
    twins = pair_half_edges(surface.offsets, surface.corners.astype(np.int64), surface.n_vertices, 2)
    np.testing.assert_array_equal(twins, surface.twins)


def test_a_polygon_of_many_corners_meets_its_neighbours():
    """A prism over a polygon that has too many corners to compare all of them with one another."""
    n = 500
    rim = np.arange(n)
    following = (rim + 1) % n
    sides = np.stack([rim, following, following + n, rim + n], axis=1)
    corners = np.concatenate([sides.reshape(-1), rim[::-1], rim + n]).astype(np.int32)
    offsets = np.concatenate([np.arange(n + 1) * 4, [5 * n, 6 * n]])
    twins = pair_half_edges(offsets, corners, 2 * n, 1)
    assert (twins >= 0).all()
    np.testing.assert_array_equal(twins[twins], np.arange(corners.size))
