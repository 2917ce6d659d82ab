"""Small ONNX models for tests, and their values by onnxruntime and by the importer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from mn_onnx.importer import Imported, import_network
from mn_onnx.ir.evaluate import evaluate

onnxruntime.set_default_logger_severity(3)

node = helper.make_node


def int64(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


def float32(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([seed, *shape]).normal(size=shape).astype(np.float32)


def model_of(
    nodes: Sequence[onnx.NodeProto],
    constants: Mapping[str, ArrayLike],
    *,
    inputs: Mapping[str, Sequence[int | str | None] | None] | None = None,
    outputs: Sequence[str] = ("y",),
    opset: int = 17,
    domains: Sequence[str] = (),
    types: Mapping[str, int] | None = None,
) -> onnx.ModelProto:
    """A model of the given nodes; inputs and outputs are float32 unless ``types`` says otherwise."""
    types = types or {}

    def info(name: str, shape: Sequence[int | str | None] | None) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, types.get(name, TensorProto.FLOAT), shape)

    graph = helper.make_graph(
        list(nodes),
        "test",
        [info(name, shape) for name, shape in (inputs or {"x": ("N", 3)}).items()],
        [info(name, None) for name in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(domain, 1) for domain in domains)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def run(model: onnx.ModelProto, feeds: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """All outputs by onnxruntime."""
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, dict(feeds)), strict=True))


def runtime_values(model: onnx.ModelProto, imported: Imported, points: np.ndarray) -> np.ndarray:
    """The field by onnxruntime, fed through the imported layout."""
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def call(feeds: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return dict(zip(names, session.run(names, dict(feeds)), strict=True))

    return imported.layout.evaluate(call, points)


def imported_values(imported: Imported, points: np.ndarray) -> np.ndarray:
    """The field by the importer, in float64 with true activations."""
    return evaluate(imported.network, points, true_functions=True)


def points_in_box(dim: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(dim).uniform(-1, 1, (n, dim)).astype(np.float32).astype(np.float64)


def assert_agrees(model: onnx.ModelProto, *, tolerance: float = 2e-5, **options: Any) -> Imported:
    """Import a model and compare its values with onnxruntime, relative to the largest."""
    imported = import_network(model, **options)
    points = points_in_box(imported.input_dim)
    expected = runtime_values(model, imported, points)
    actual = imported_values(imported, points)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max()))
    return imported
