"""Which inputs hold the points, which columns are coordinates, what is bound, and which output is the field."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from onnx_models import assert_agrees, float32, imported_values, int64, model_of, node, points_in_box

from mn_onnx.errors import ModelRefused, UsageError
from mn_onnx.importer import import_network
from mn_onnx.layout import BoundInput

W, V = float32(3, 5), float32(5, 1)


def field(name: str = "x") -> list[onnx.NodeProto]:
    return [node("MatMul", [name, "W"], ["p"]), node("Relu", ["p"], ["h"]), node("MatMul", ["h", "V"], ["y"])]


def wide_model() -> onnx.ModelProto:
    """Points of seven columns."""
    return model_of(field(), constants(7), inputs={"x": ("N", 7)})


def constants(width: int = 3) -> dict[str, np.ndarray]:
    return {"W": float32(width, 5), "V": V}


@pytest.mark.parametrize(
    ("shape", "dim"),
    [
        (("N", 3), 3),
        ((1, 3), 3),
        ((3,), 3),
        (("N", 2), 2),
        (("N", 1), 1),
        ((1, "N", 3), 3),
        (("B", "N", 3), 3),
        (("N", 1, 3), 3),
        ((7, 3), 3),
        ((2, 3), 3),
        ((3, 3), 3),
        ((3, 2), 2),
    ],
)
def test_coordinates_on_the_last_axis(shape: tuple[int | str, ...], dim: int) -> None:
    imported = assert_agrees(model_of(field(), constants(dim), inputs={"x": shape}))
    assert imported.input_dim == dim


@pytest.mark.parametrize("shape", [(1, 3, "N"), ("N", 3, 1), (1, 3, 8)])
def test_coordinates_on_the_channel_axis(shape: tuple[int | str, ...]) -> None:
    nodes = [node("Conv", ["x", "K"], ["p"]), node("Relu", ["p"], ["h"]), node("Conv", ["h", "L"], ["y"])]
    assert_agrees(model_of(nodes, {"K": float32(5, 3, 1), "L": float32(1, 5, 1)}, inputs={"x": shape}))


def test_points_as_images_of_one_pixel() -> None:
    nodes = [node("Conv", ["x", "K"], ["p"]), node("Relu", ["p"], ["h"]), node("Conv", ["h", "L"], ["y"])]
    weights = {"K": float32(5, 3, 1, 1), "L": float32(1, 5, 1, 1)}
    assert_agrees(model_of(nodes, weights, inputs={"x": ("N", 3, 1, 1)}))


def test_coordinates_on_the_first_axis() -> None:
    nodes = [node("MatMul", ["K", "x"], ["p"]), node("Relu", ["p"], ["h"]), node("MatMul", ["L", "h"], ["y"])]
    assert_agrees(model_of(nodes, {"K": float32(5, 3), "L": float32(1, 5)}, inputs={"x": (3, "N")}))


@pytest.mark.parametrize(
    ("names", "shape"),
    [
        (("x", "y", "z"), ("N", 1)),
        (("u", "v"), ("N", 1)),
        (("a", "b", "c"), (1, "N", 1)),
        (("x", "y"), (1, 1)),
    ],
)
def test_one_input_per_coordinate(names: tuple[str, ...], shape: tuple[int | str, ...]) -> None:
    nodes = [node("Concat", list(names), ["all"], axis=-1), *field("all")]
    nodes[-1].output[0] = "f"
    model = model_of(nodes, constants(len(names)), inputs=dict.fromkeys(names, shape), outputs=["f"])
    assert assert_agrees(model).input_dim == len(names)


def test_coordinates_without_a_column_axis() -> None:
    nodes = [node("Unsqueeze", [name, "axes"], [name + "1"]) for name in "uv"]
    nodes += [node("Concat", ["u1", "v1"], ["all"], axis=1), *field("all"), node("Squeeze", ["y", "axes"], ["f"])]
    inputs = {"u": ("N",), "v": ("N",)}
    assert_agrees(model_of(nodes, constants(2) | {"axes": int64(1)}, inputs=inputs, outputs=["f"]))


def test_order_of_the_coordinates_can_be_chosen() -> None:
    nodes = [node("Concat", ["xy", "h0"], ["all"], axis=-1), *field("all")]
    model = model_of(nodes, constants(3), inputs={"xy": ("N", 2), "h0": ("N", 1)})
    with pytest.raises(ModelRefused, match="not bound"):
        import_network(model)
    imported = assert_agrees(model, coordinates=["h0", "xy[1]", "xy[0]"])
    swapped = assert_agrees(model, coordinates=["xy", "h0"])
    points = points_in_box(3)
    np.testing.assert_allclose(
        imported_values(imported, points), imported_values(swapped, points[:, ::-1]), rtol=0, atol=1e-14
    )


BINDINGS: dict[str, dict[str, Any]] = {
    "a range of columns": {"bind": {"x[0:4]": float32(4)}},
    "single columns": {"bind": {"x[0]": 0.5, "x[1]": 0.25, "x[2,3]": [1.0, -1.0]}},
    "columns from the end": {"bind": {"x[-4:]": float32(4)}},
    "one number for several columns": {"bind": {"x[:4]": 0.3}},
    "the rest of the columns": {"bind": {"x": float32(4)}, "coordinates": [4, 5, 6]},
}


@pytest.mark.parametrize("name", BINDINGS)
def test_extra_columns(name: str) -> None:
    model = wide_model()
    assert assert_agrees(model, **BINDINGS[name]).input_dim == 3


def test_unbound_columns_are_refused() -> None:
    model = wide_model()
    with pytest.raises(ModelRefused, match=r"7 columns that are not bound"):
        import_network(model)
    with pytest.raises(ModelRefused, match=r"4 columns that are not bound"):
        import_network(model, coordinates=[0, 1, 2])


@pytest.mark.parametrize("shape", [("N", 4), (1, 4), (4,), ("M", 4)])
def test_latent_inputs(shape: tuple[int | str, ...]) -> None:
    """A code per point, one for all, or without batch axis, added to the first layer."""
    nodes = [
        node("MatMul", ["code", "C"], ["shift"]),
        node("MatMul", ["x", "W"], ["q"]),
        node("Add", ["q", "shift"], ["p"]),
        *field()[1:],
    ]
    model = model_of(nodes, constants() | {"C": float32(4, 5)}, inputs={"code": shape, "x": ("N", 3)})
    imported = assert_agrees(model, bind={"code": float32(4)})
    assert isinstance(imported.layout.inputs[0], BoundInput)
    with pytest.raises(ModelRefused, match=r"input 'code'.*\n  Fix: .*--bind code="):
        import_network(model)


def test_scalar_time_and_integer_index() -> None:
    nodes = [
        node("Gather", ["table", "index"], ["row"]),
        node("Mul", ["row", "t"], ["moved"]),
        node("MatMul", ["x", "W"], ["q"]),
        node("Add", ["q", "moved"], ["p"]),
        *field()[1:],
    ]
    inputs = {"x": ("N", 3), "index": (1,), "t": ()}
    model = model_of(nodes, constants() | {"table": float32(4, 5)}, inputs=inputs, types={"index": TensorProto.INT64})
    assert_agrees(model, bind={"index": 2, "t": 0.25})
    with pytest.raises(ModelRefused) as refused:
        import_network(model)
    assert "index" in str(refused.value)


@pytest.mark.parametrize("shape", [("N", "D"), (None, None), None])
@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_number_of_columns_that_is_not_declared_is_found(shape: Any, width: int) -> None:
    model = model_of(field(), constants(width), inputs={"x": shape})
    assert assert_agrees(model).input_dim == width


def test_three_scalars() -> None:
    nodes = [node("Unsqueeze", [name, "axes"], [name + "1"]) for name in "abc"]
    nodes += [node("Concat", ["a1", "b1", "c1"], ["all"], axis=0), *field("all")]
    model = model_of(nodes, constants() | {"axes": int64(0)}, inputs=dict.fromkeys("abc", ()))
    assert assert_agrees(model).layout.batch == 1


WRONG: dict[str, dict[str, Any]] = {
    "unknown input": {"bind": {"latent": 1.0}},
    "unknown column": {"bind": {"x[9]": 1.0}},
    "no columns": {"bind": {"x[a]": 1.0}},
    "wrong number of values": {"bind": {"x[0:4]": [1.0, 2.0]}},
    "values of another shape": {"bind": {"x": float32(4)}},
    "everything bound": {"bind": {"x": np.zeros((1, 7))}},
    "a coordinate twice": {"coordinates": [0, 0, 1], "bind": {"x": float32(5)}},
    "unknown output": {"output": "sdf", "bind": {"x[0:4]": 0.0}},
    "unknown channel": {"channel": 3, "bind": {"x[0:4]": 0.0}},
}


@pytest.mark.parametrize("name", WRONG)
def test_options_that_do_not_fit(name: str) -> None:
    with pytest.raises(UsageError):
        import_network(wide_model(), **WRONG[name])


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((1, 3, 224, 224), TensorProto.FLOAT),
        (("N", 1, 28, 28), TensorProto.FLOAT),
        ((1, 32), TensorProto.INT64),
        (("N", 3), TensorProto.INT64),
        ((4, "N", 3), TensorProto.FLOAT),
    ],
)
def test_inputs_that_are_no_points(shape: tuple[int | str, ...], kind: int) -> None:
    model = model_of([node("Cast", ["x"], ["y"], to=1)], {}, inputs={"x": shape}, types={"x": kind})
    with pytest.raises(ModelRefused) as refused:
        import_network(model)
    assert refused.value.problems[0].node == "input 'x'"


HEADS = [
    node("MatMul", ["h", "V"], ["sdf"]),
    node("MatMul", ["h", "U"], ["features"]),
    node("Sigmoid", ["features"], ["rgb"]),
]


def test_the_only_output_with_one_value_per_point_is_chosen() -> None:
    model = model_of([*field()[:2], *HEADS], constants() | {"U": float32(5, 3)}, outputs=["rgb", "sdf", "features"])
    assert assert_agrees(model).layout.output.name == "sdf"
    chosen = assert_agrees(model, output="features", channel=-1).layout.output
    assert (chosen.name, chosen.channel) == ("features", 2)
    with pytest.raises(ModelRefused, match=r"3 channels.*\n  Fix: choose one, from 0 to 2: --output rgb:0"):
        import_network(model, output="rgb")


def test_equal_outputs_must_be_chosen() -> None:
    nodes = [*field()[:2], node("MatMul", ["h", "V"], ["a"]), node("Neg", ["a"], ["b"])]
    model = model_of(nodes, constants(), outputs=["a", "b"])
    with pytest.raises(ModelRefused, match="'a', 'b'"):
        import_network(model)
    assert_agrees(model, output="b")


@pytest.mark.parametrize("shape", [(-1,), (-1, 1), (1, -1), (1, -1, 1), (-1, 1, 1)])
def test_shapes_of_the_output(shape: tuple[int, ...]) -> None:
    nodes = [*field(), node("Reshape", ["y", "shape"], ["f"])]
    assert_agrees(model_of(nodes, constants() | {"shape": int64(*shape)}, outputs=["f"]))


def test_a_constant_field_is_imported() -> None:
    nodes = [node("Mul", ["x", "zero"], ["h"]), node("ReduceSum", ["h"], ["y"], axes=[1])]
    imported = import_network(model_of(nodes, {"zero": np.float32(0)}, opset=11))
    assert not imported.network.units
    assert not imported.network.output.columns.size


def test_metadata_and_initialised_inputs() -> None:
    model = model_of(field(), constants())
    entry = model.metadata_props.add()
    entry.key, entry.value = "bounds", "[-1, 1]"
    model.graph.input.append(onnx.helper.make_tensor_value_info("W", TensorProto.FLOAT, [3, 5]))
    imported = import_network(model)
    assert imported.metadata == {"bounds": "[-1, 1]"}
    assert imported.input_dim == 3
