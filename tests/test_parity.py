"""The comparison of an imported network with other programs."""

from __future__ import annotations

from typing import cast

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper
from onnx_models import float32, model_of, node
from small_models import octahedron_model

import mn_onnx
from mn_onnx.checks.parity import check_parity, coarsest_rounding, probe_points
from mn_onnx.checks.runtime import BATCH, Runtime
from mn_onnx.ir.evaluate import rounding_error_bound

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def model() -> mn_onnx.Model:
    return mn_onnx.load(octahedron_model(), bounds=[(-1, 1), (-1, 2), (0, 3)])


def test_points_are_in_the_box_at_its_corners_and_near_the_level_set(model: mn_onnx.Model) -> None:
    points = probe_points(model)
    assert (points >= model.lower).all()
    assert (points <= model.upper).all()
    np.testing.assert_array_equal(points, points.astype(np.float32))
    rows = {tuple(point) for point in points.tolist()}
    assert {(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 2.0) for z in (0.0, 3.0)} <= rows
    values = model.evaluate(points)
    assert np.count_nonzero(np.abs(values) < 1e-4) > 1000
    assert np.count_nonzero(np.abs(values) > 0.1) > 1000


class Faulty:
    """The model itself, but for an error in batches of at most ``largest_batch`` points."""

    name, note = "a faulty program", ""

    def __init__(self, model: mn_onnx.Model, largest_batch: int, error: float) -> None:
        self.model, self.largest_batch, self.error = model, largest_batch, error

    def evaluate(self, points: Floats, *, batch: int = BATCH) -> Floats:
        return self.model.evaluate(points) + (self.error if batch <= self.largest_batch else 0.0)


@pytest.mark.parametrize("error", [1e-4, np.nan])
@pytest.mark.parametrize("largest_batch", [1, 2, 7, BATCH])
def test_an_error_in_batches_of_some_size_is_found(model: mn_onnx.Model, largest_batch: int, error: float) -> None:
    runtime = cast(Runtime, Faulty(model, largest_batch, error))
    (problem,) = check_parity(model, runtime).problems()
    assert ("a faulty program has values" if np.isnan(error) else "differs from a faulty program") in problem
    assert check_parity(model, cast(Runtime, Faulty(model, 0, error))).problems() == []


def test_a_wrong_deep_network_is_found_though_knots_might_explain_it() -> None:
    """Forward errors grow with every level: in the worst case there is a knot within them at every point."""
    nodes, constants, last = [], {}, "x"
    for level in range(8):
        width = 3 if level == 0 else 64
        constants[f"W{level}"] = float32(width, 64, seed=level) * np.float32(np.sqrt(2 / width))
        nodes += [node("MatMul", [last, f"W{level}"], [f"t{level}"]), node("Relu", [f"t{level}"], [f"a{level}"])]
        last = f"a{level}"
    constants["O"] = float32(64, 1)
    model = mn_onnx.load(model_of([*nodes, node("MatMul", [last, "O"], ["y"])], constants))
    right = check_parity(model, Runtime(model.read, model.imported.layout))
    assert right.problems() == []
    assert right.unexplained_share == 0
    size = float(np.median(np.abs(model.evaluate(probe_points(model)))))
    wrong = check_parity(model, cast(Runtime, Faulty(model, BATCH, 0.01 * size)))
    assert wrong.worst_ratio < 1
    assert "differs from a faulty program" in wrong.problems()[0]


def test_rounding_of_constants_that_cancel_is_allowed_for() -> None:
    """``(1 - 2 |x|) - 1`` is off by half a unit in the last place of 1, however small ``x`` is."""
    nodes = [
        helper.make_node("Abs", ["x"], ["a"]),
        helper.make_node("Gemm", ["a", "W", "one"], ["g"]),
        helper.make_node("Sub", ["g", "one"], ["y"]),
    ]
    constants = {"W": np.array([[-2.0]], np.float32), "one": np.ones(1, np.float32)}
    model = mn_onnx.load(model_of(nodes, constants, inputs={"x": ("N", 1)}))
    runtime = Runtime(model.read, model.imported.layout)
    points = probe_points(model)
    difference = np.abs(runtime.evaluate(points) - model.evaluate(points))
    assert (difference > rounding_error_bound(model.imported.network, points, unit_roundoff=2.0**-24)).any()
    assert check_parity(model, runtime).problems() == []


def test_the_coarsest_number_format_decides() -> None:
    model = octahedron_model()
    assert coarsest_rounding(model) == 2.0**-24
    node = helper.make_node("Cast", ["y"], ["half"], to=TensorProto.FLOAT16)
    model.graph.node.append(node)
    assert coarsest_rounding(model) == 2.0**-11
    weights = onnx.TensorProto(name="w", data_type=TensorProto.BFLOAT16, dims=[1], raw_data=b"\x80\x3f")
    model.graph.initializer.append(weights)
    assert coarsest_rounding(model) == 2.0**-8
