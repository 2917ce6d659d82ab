"""What the reader accepts, what it refuses, and that it names every reason."""

from __future__ import annotations

import gzip
import hashlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import onnx
import pytest
from google.protobuf import json_format, text_format
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from mn_onnx.errors import ModelRefused, UsageError
from mn_onnx.reader import read_model

WEIGHT = np.arange(12, dtype=np.float32).reshape(4, 3)


def small_model(*, opset: int = 13, ir_version: int = 8) -> onnx.ModelProto:
    """Relu(x W^T) v: one hidden layer of four units."""
    nodes = [
        helper.make_node("Gemm", ["x", "W"], ["h"], name="gemm", transB=1),
        helper.make_node("Relu", ["h"], ["r"], name="relu"),
        helper.make_node("MatMul", ["r", "v"], ["y"], name="last"),
    ]
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(WEIGHT, "W"), numpy_helper.from_array(np.ones((4, 1), np.float32), "v")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir_version)


def refusal(source: object) -> str:
    with pytest.raises(ModelRefused) as caught:
        read_model(source)  # type: ignore[arg-type]
    assert caught.value.problems
    return str(caught.value)


def weights(model: onnx.ModelProto) -> dict[str, np.ndarray]:
    return {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}


def test_reads_paths_bytes_and_messages_alike(tmp_path: Path) -> None:
    data = small_model().SerializeToString()
    path = tmp_path / "small.onnx"
    path.write_bytes(data)
    for source in (path, str(path), data, small_model()):
        read = read_model(source)
        assert [node.name for node in read.model.graph.node] == ["gemm", "relu", "last"]
        np.testing.assert_array_equal(weights(read.model)["W"], WEIGHT)
    assert read_model(path).sha256 == hashlib.sha256(data).hexdigest()
    assert read_model(path).name == "small.onnx"


@pytest.mark.parametrize(
    "encode",
    [
        lambda model: gzip.compress(model.SerializeToString()),
        lambda model: gzip.compress(model.SerializeToString()[:50]) + gzip.compress(model.SerializeToString()[50:]),
        lambda model: json_format.MessageToJson(model).encode(),
        lambda model: text_format.MessageToString(model).encode(),
        lambda model: onnx.printer.to_text(model).encode(),
    ],
    ids=["gzip", "gzip in two members", "json", "text protobuf", "onnx text"],
)
def test_reads_other_encodings(encode) -> None:
    model = small_model()
    read = read_model(encode(model)).model
    assert [node.op_type for node in read.graph.node] == ["Gemm", "Relu", "MatMul"]
    np.testing.assert_array_equal(weights(read)["W"], WEIGHT)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
        (b"PK\x03\x04" + bytes(40), "PyTorch"),
        (b"\x80\x04\x95" + bytes(40), "pickle"),
        (b"\x89HDF\r\n\x1a\n" + bytes(40), "Keras"),
        (b"<!DOCTYPE html><html></html>", "web page"),
        (b"This is not a model.\n", "text file"),
        (b"<ir_version: 8>\nnonsense", "text file"),
        (b'{"graph": 3}', "text file"),
        (gzip.compress(small_model().SerializeToString())[:-20], "gzip"),
        (b"\x1f\x8b" + bytes(30), "gzip"),
        (small_model().SerializeToString()[:150], "damaged"),
        (b"\x08\x08", "no graph"),
    ],
)
def test_says_what_other_files_are(data: bytes, words: str) -> None:
    message = refusal(data)
    assert words in message
    assert "Fix:" in message


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(data: bytes) -> None:
    refusal(data)


@settings(max_examples=500, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 255))
def test_a_changed_byte_is_refused_or_read(position: int, value: int) -> None:
    data = bytearray(small_model().SerializeToString())
    data[position % len(data)] = value
    with suppress(ModelRefused):
        assert read_model(bytes(data)).model.graph.node


def test_missing_files_and_folders_are_usage_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no model file"):
        read_model(tmp_path / "missing.onnx")
    with pytest.raises(UsageError, match="folder"):
        read_model(tmp_path)


def test_all_problems_are_named_at_once() -> None:
    model = small_model()
    model.graph.initializer.append(numpy_helper.from_array(np.ones(1, np.float32), "v"))
    model.graph.node[1].input[0] = "nowhere"
    model.graph.node.append(helper.make_node("Relu", ["r"], ["h"], name="again"))
    message = refusal(model)
    assert "v: 2 initializers" in message
    assert "relu (Relu, opset 13): its input 'nowhere' is defined nowhere" in message
    assert "again (Relu, opset 13): it writes the tensor 'h'" in message


def test_the_message_passed_in_is_not_changed() -> None:
    model = small_model()
    model.graph.node.insert(0, model.graph.node.pop())
    before = model.SerializeToString(deterministic=True)
    read_model(model)
    assert model.SerializeToString(deterministic=True) == before


def test_unsorted_nodes_are_sorted_and_cycles_refused() -> None:
    unsorted = small_model()
    unsorted.graph.node.insert(0, unsorted.graph.node.pop())
    assert [node.name for node in read_model(unsorted).model.graph.node] == ["gemm", "relu", "last"]
    cyclic = small_model()
    cyclic.graph.node[0].input[0] = "y"
    message = refusal(cyclic)
    assert "cycle" in message
    assert "gemm (Gemm)" in message


def test_names_of_outer_graphs_are_seen_inside_branches() -> None:
    def branch(name: str, source: str) -> onnx.GraphProto:
        out = helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
        return helper.make_graph(
            [helper.make_node("Identity", [source], [name], name=f"copy {source}")], name, [], [out]
        )

    def model_with(source: str) -> onnx.ModelProto:
        model = small_model()
        model.graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
        model.graph.node[2].output[0] = "z"
        fork = helper.make_node(
            "If", ["yes"], ["y"], name="fork", then_branch=branch("a", source), else_branch=branch("b", "z")
        )
        model.graph.node.insert(0, fork)
        return model

    assert [node.name for node in read_model(model_with("r")).model.graph.node][-1] == "fork"
    assert "copy gone (Identity, opset 13): its input 'gone' is defined nowhere" in refusal(model_with("gone"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda model: model.graph.ClearField("input"), "no inputs"),
        (lambda model: model.graph.ClearField("output"), "no outputs"),
        (lambda model: model.graph.ClearField("node"), "no nodes"),
        (lambda model: model.ClearField("opset_import"), "opset_import"),
        (lambda model: setattr(model.opset_import[0], "version", 99), "opset 99"),
        (lambda model: setattr(model.opset_import[0], "version", 0), "opset 0"),
        (lambda model: model.opset_import.append(helper.make_opsetid("ai.onnx", 14)), "several versions"),
        (lambda model: setattr(model.graph.node[1], "domain", "com.example"), "com.example"),
        (
            lambda model: model.graph.node[0].attribute.append(helper.make_attribute("gamma", 1.0)),
            "gemm (Gemm, opset 13)",
        ),
        (lambda model: model.graph.node[1].ClearField("input"), "relu (Relu, opset 13)"),
    ],
)
def test_malformed_graphs_are_refused(change, words: str) -> None:
    model = small_model()
    change(model)
    assert words in refusal(model)


def test_formats_newer_than_the_installed_onnx_are_read() -> None:
    read = read_model(small_model(ir_version=999))
    assert read.model.ir_version <= onnx.IR_VERSION
    onnx.checker.check_model(read.model)


@pytest.mark.parametrize(
    ("tensor", "words"),
    [
        (TensorProto(name="W", data_type=TensorProto.FLOAT, dims=[4, 3], raw_data=bytes(40)), "cannot be read"),
        (TensorProto(name="W", data_type=TensorProto.FLOAT, dims=[4, 3], raw_data=bytes(56)), "cannot be read"),
        (TensorProto(name="W", data_type=TensorProto.FLOAT, dims=[2**31, 2**31], raw_data=bytes(48)), "holds only"),
        (TensorProto(name="W", data_type=TensorProto.FLOAT, dims=[-4, 3], raw_data=bytes(48)), "negative"),
        (TensorProto(name="W", data_type=77, dims=[4, 3], raw_data=bytes(48)), "cannot be read"),
        (numpy_helper.from_array(np.where(WEIGHT == 3, np.nan, WEIGHT).astype(np.float32), "W"), "NaN"),
        (numpy_helper.from_array(np.where(WEIGHT == 3, np.inf, WEIGHT).astype(np.float16), "W"), "infinite"),
    ],
)
def test_damaged_weights_are_refused(tensor: TensorProto, words: str) -> None:
    model = small_model()
    model.graph.initializer[0].CopyFrom(tensor)
    message = refusal(model)
    assert "W" in message
    assert words in message


def test_damaged_constant_nodes_are_refused_by_name() -> None:
    model = small_model()
    broken = TensorProto(data_type=TensorProto.FLOAT, dims=[4, 3], raw_data=bytes(8))
    model.graph.node.insert(0, helper.make_node("Constant", [], ["c"], name="table", value=broken))
    assert "table: " in refusal(model)


@pytest.mark.parametrize("flat", [True, False])
def test_sparse_weights_become_dense(flat: bool) -> None:
    model = small_model()
    nonzero = np.argwhere(WEIGHT)
    indices = np.ravel_multi_index(tuple(nonzero.T), WEIGHT.shape) if flat else nonzero
    values = numpy_helper.from_array(WEIGHT[tuple(nonzero.T)], "W")
    sparse = helper.make_sparse_tensor(values, numpy_helper.from_array(indices.astype(np.int64)), WEIGHT.shape)
    del model.graph.initializer[0]
    model.graph.sparse_initializer.append(sparse)
    np.testing.assert_array_equal(weights(read_model(model).model)["W"], WEIGHT)


@pytest.mark.parametrize(("shape", "index"), [((4, 3), 12), ((2**40, 2**20), 0)])
def test_sparse_weights_that_do_not_fit_are_refused(shape: tuple[int, int], index: int) -> None:
    model = small_model()
    values = numpy_helper.from_array(np.ones(1, np.float32), "W")
    sparse = helper.make_sparse_tensor(values, numpy_helper.from_array(np.array([index], np.int64)), shape)
    del model.graph.initializer[0]
    model.graph.sparse_initializer.append(sparse)
    assert "W: the sparse initializer" in refusal(model)


def test_functions_are_inlined() -> None:
    model = small_model()
    body = helper.make_function(
        "local", "Layer", ["a"], ["b"], [helper.make_node("Relu", ["a"], ["b"])], [helper.make_opsetid("", 13)]
    )
    model.functions.append(body)
    model.opset_import.append(helper.make_opsetid("local", 1))
    model.graph.node[1].op_type, model.graph.node[1].domain = "Layer", "local"
    read = read_model(model)
    assert [node.op_type for node in read.model.graph.node] == ["Gemm", "Relu", "MatMul"]
    assert not read.model.functions
    assert read.original.functions


class TestExternalData:
    """Weights beside the model, and only there."""

    @staticmethod
    def store(folder: Path, location: str) -> Path:
        model = small_model()
        tensor = model.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=location)
        path = folder / "model.onnx"
        path.write_bytes(model.SerializeToString())
        return path

    def test_is_read_from_the_folder_of_the_model(self, tmp_path: Path) -> None:
        path = self.store(tmp_path, "weights.bin")
        (tmp_path / "weights.bin").write_bytes(WEIGHT.tobytes())
        read = read_model(path)
        np.testing.assert_array_equal(weights(read.model)["W"], WEIGHT)
        assert read.sha256 == hashlib.sha256(path.read_bytes() + WEIGHT.tobytes()).hexdigest()

    def test_missing_or_short_files_are_named(self, tmp_path: Path) -> None:
        path = self.store(tmp_path, "weights.bin")
        assert "'weights.bin' is missing" in refusal(path)
        (tmp_path / "weights.bin").write_bytes(bytes(8))
        assert "W: " in refusal(path)

    @pytest.mark.parametrize("location", ["../secret.bin", "sub/../../secret.bin", "", "/etc/hostname"])
    def test_outside_the_folder_is_refused(self, tmp_path: Path, location: str) -> None:
        (tmp_path / "secret.bin").write_bytes(WEIGHT.tobytes())
        folder = tmp_path / "model"
        folder.mkdir()
        assert "outside the folder" in refusal(self.store(folder, location))

    def test_links_out_of_the_folder_are_refused(self, tmp_path: Path) -> None:
        (tmp_path / "secret.bin").write_bytes(WEIGHT.tobytes())
        folder = tmp_path / "model"
        folder.mkdir()
        (folder / "weights.bin").symlink_to(tmp_path / "secret.bin")
        assert "outside the folder" in refusal(self.store(folder, "weights.bin"))

    def test_needs_a_path(self, tmp_path: Path) -> None:
        assert "without a folder" in refusal(self.store(tmp_path, "weights.bin").read_bytes())
