"""Curves and roots against the exact oracle, and files of polylines."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from mn_onnx.extract.files.polygon_mesh import MeshFileError
from mn_onnx.extract.planar.curve import Curve
from mn_onnx.extract.planar.embed import embed
from mn_onnx.extract.planar.files import write_curve
from mn_onnx.extract.planar.prism import extract_curve, extract_roots
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import Network
from oracle.integer_networks import IntegerNetwork
from oracle.level_set import exact_level_set
from oracle.random_networks import RandomNetwork
from oracle.sketch import Sketch, as_network

GENERIC = [
    (("relu", 6),),
    (("relu", 5), ("relu", 5)),
    (("clip", 3), ("abs", 4)),
    (("maximum", 4), ("leaky_relu", 4), ("relu", 3)),
]


def square(half: float = 0.5) -> Network:
    """``max(|x|, |y|) - half``, by ``|y| + relu(|x| - |y|)``."""
    return as_network(
        lambda sketch, x: sketch.affine(
            sketch.maximum(sketch.abs(sketch.affine(x, [[1, 0]], [0])), sketch.abs(sketch.affine(x, [[0, 1]], [0]))),
            [[1]],
            [-half],
        ),
        2,
    )


def networks(dimension: int) -> list[Network]:
    generic = [RandomNetwork(dimension, layers, True, seed).centred() for layers in GENERIC for seed in (1, 2)]
    return [
        as_network(body, dimension) for body in [*generic, *(IntegerNetwork(seed, dimension) for seed in range(30))]
    ]


@pytest.mark.parametrize("network", networks(2))
def test_curves_match_the_oracle(network: Network) -> None:
    lower, upper = np.array([-1.0, -0.75]), np.array([1.25, 1.0])
    exact = exact_level_set(network, lower, upper)
    curve = extract_curve(network, lower, upper, threads=1).curve
    assert curve.problems() == []
    assert curve.length == pytest.approx(exact.length, abs=1e-9)
    assert np.abs(evaluate(network, curve.vertices)).max(initial=0.0) < 1e-13
    # The oracle keeps larger values on the left.
    expected = [[*map(float, (*f.vertices[1], *f.vertices[0], *f.gradient))] for f in exact.facets]
    found = np.concatenate([curve.vertices[curve.segments].reshape(-1, 4), curve.gradients], axis=1)
    np.testing.assert_allclose(_sorted_rows(found), _sorted_rows(np.reshape(expected, (-1, 6))), atol=1e-8)


def _sorted_rows(rows: np.ndarray) -> np.ndarray:
    return np.array(sorted((np.round(rows, 9) + 0.0).tolist())).reshape(-1, 6)


@pytest.mark.parametrize("network", networks(1))
def test_roots_match_the_oracle(network: Network) -> None:
    exact = exact_level_set(network, [-1.0], [1.25])
    expected = [(float(facet.vertices[0][0]), float(facet.gradient[0])) for facet in exact.facets]
    expected.sort(key=lambda root: (root[0], -root[1]))  # f rises to a zero that it only touches, and falls then
    roots = extract_roots(network, np.array([-1.0]), np.array([1.25]), threads=1).roots
    assert roots.problems() == []
    np.testing.assert_allclose(roots.positions, [position for position, _ in expected], atol=1e-12)
    np.testing.assert_allclose(roots.slopes, [slope for _, slope in expected], atol=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_where_f_touches_zero_it_rises_to_it_and_falls(seed: int) -> None:
    """Two zeros of ``-slope | |a x + b| - 0.2 |``, each a root from either side, in places equal but for rounding."""
    generator = np.random.default_rng(seed)
    slope, scale, shift = generator.uniform(0.1, 3.0, 3)

    def body(sketch: Sketch[Any], x: Any) -> Any:
        distance = sketch.abs(sketch.affine(x, [[1 + scale]], [shift / 4]))
        return sketch.affine(sketch.abs(sketch.affine(distance, [[1.0]], [-0.2])), [[-slope]], [0.0])

    roots = extract_roots(as_network(body, 1), np.array([-1.5]), np.array([1.5]), threads=1).roots
    assert roots.problems() == []
    zeros = (np.array([-0.2, 0.2]) - shift / 4) / (1 + scale)
    np.testing.assert_allclose(roots.positions, zeros.repeat(2), atol=1e-12)
    assert (np.sign(roots.slopes) == [1, -1, 1, -1]).all()


def test_a_square_is_one_polyline_around_its_inside() -> None:
    curve = extract_curve(square(), np.full(2, -1.0), np.full(2, 1.0)).curve
    assert curve.closed.tolist() == [True]
    assert curve.length == pytest.approx(4)
    assert curve.area == pytest.approx(1)
    assert len(curve.polyline(0)) == curve.n_segments == 8
    outside = replace(square().output, weights=-square().output.weights, bias=-square().output.bias)
    inverted = extract_curve(replace(square(), output=outside), np.full(2, -1.0), np.full(2, 1.0)).curve
    assert inverted.area == pytest.approx(-1)


def test_a_curve_that_leaves_the_box_is_open() -> None:
    curve = extract_curve(square(), np.array([0.0, -1.0]), np.full(2, 1.0)).curve
    assert curve.closed.tolist() == [False]
    assert curve.area is None
    points = curve.polyline(0)
    np.testing.assert_allclose(points[[0, -1]], [[0, -0.5], [0, 0.5]], atol=1e-15)
    assert curve.problems() == []


def test_an_open_end_inside_the_box_is_a_problem() -> None:
    curve = extract_curve(square(), np.full(2, -1.0), np.full(2, 1.0)).curve
    kept = np.arange(curve.n_segments - 1)
    torn = Curve.from_segments(
        curve.vertices, curve.segments[kept], curve.gradients[kept], curve.errors[kept], curve.lower, curve.upper
    )
    assert torn.closed.tolist() == [False]
    assert torn.problems() == ["2 ends of polylines are inside the box"]
    turned = replace(curve, gradients=-curve.gradients)
    assert turned.problems() == ["8 segments run against their gradient"]


def test_several_outlines_are_chained_apart() -> None:
    corners = np.array([[0, 0], [1, 0], [0, 1.0]])
    vertices = np.concatenate([corners, corners + 2])
    segments = np.array([[1, 2], [3, 4], [0, 1], [5, 3], [2, 0], [4, 5]])
    curve = Curve.from_segments(vertices, segments, np.zeros((6, 2)), np.zeros(6), np.zeros(2), np.full(2, 4.0))
    assert curve.offsets.tolist() == [0, 3, 6]
    assert curve.closed.tolist() == [True, True]
    assert curve.segments.tolist() == [[1, 2], [2, 0], [0, 1], [3, 4], [4, 5], [5, 3]]


@pytest.mark.parametrize(
    ("dimension", "lower", "upper", "message"),
    [(2, [0, 0], [1, 0], "no interior"), (2, [0], [1], "no interior"), (4, [0] * 4, [1] * 4, "4 inputs")],
)
def test_senseless_boxes_and_dimensions_are_refused(
    dimension: int, lower: list[float], upper: list[float], message: str
) -> None:
    network = as_network(RandomNetwork(dimension, (("relu", 2),), False, 0), dimension)
    with pytest.raises(ValueError, match=message):
        embed(network, np.array(lower, float), np.array(upper, float))


def test_networks_of_another_dimension_are_refused() -> None:
    with pytest.raises(ValueError, match="2 inputs where 1"):
        extract_roots(square(), np.array([-1.0]), np.array([1.0]))


@pytest.fixture
def curve() -> Curve:
    return extract_curve(square(0.625), np.array([-1.0, 0.125]), np.full(2, 1.0)).curve


def test_json_holds_the_polylines_exactly(curve: Curve, tmp_path: Path) -> None:
    write_curve(curve, tmp_path / "curve.json")
    read = json.loads((tmp_path / "curve.json").read_text())
    assert (read["lower"], read["upper"]) == ([-1.0, 0.125], [1.0, 1.0])
    assert [polyline["closed"] for polyline in read["polylines"]] == [False]
    np.testing.assert_array_equal(read["polylines"][0]["points"], curve.polyline(0))


def test_npz_holds_the_arrays(curve: Curve, tmp_path: Path) -> None:
    write_curve(curve, tmp_path / "curve.npz")
    with np.load(tmp_path / "curve.npz") as read:
        assert set(read) == set(Curve.__dataclass_fields__)
        for name in read:
            np.testing.assert_array_equal(read[name], getattr(curve, name))


def test_svg_is_a_drawing_of_the_box(curve: Curve, tmp_path: Path) -> None:
    write_curve(curve, tmp_path / "curve.svg")
    root = ElementTree.parse(tmp_path / "curve.svg").getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.attrib["viewBox"] == "-1 -1 2 0.875"
    (path,) = root
    assert path.attrib["d"].startswith("M")
    assert path.attrib["fill"] == "none"  # an open polyline bounds nothing
    points = [[float(value) for value in point.split(",")] for point in path.attrib["d"][1:].split()]
    np.testing.assert_allclose(points, curve.polyline(0), atol=1e-8)


def test_refused_paths_leave_nothing(curve: Curve, tmp_path: Path) -> None:
    with pytest.raises(
        MeshFileError, match=r"ends in \.dxf; .* a curve, written to \.svg, \.json, \.npz.*does not exist"
    ):
        write_curve(curve, tmp_path / "missing" / "curve.dxf")
    broken = replace(curve, closed=np.array([True, True]))
    with pytest.raises(IndexError):
        write_curve(broken, tmp_path / "curve.svg")
    assert list(tmp_path.iterdir()) == []
