"""The stored tensors of a model: whether their data fit their declaration, external files, sparse storage."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import external_data_helper, numpy_helper

from mn_onnx.errors import Problem
from mn_onnx.reader.formats import PROTOBUF_LIMIT
from mn_onnx.reader.structure import inner_graphs

_STORE_ANEW = (
    "export the model again, or store its weights inside the file (onnx.save with save_as_external_data=False)"
)


@dataclass(frozen=True)
class StoredTensor:
    """A tensor and ``owner``, the initializer or node that messages name."""

    tensor: onnx.TensorProto
    owner: str


def stored_tensors(graph: onnx.GraphProto) -> Iterator[StoredTensor]:
    """Every initializer and every tensor attribute of ``graph`` and the graphs inside its nodes."""
    for tensor in graph.initializer:
        yield StoredTensor(tensor, tensor.name)
    for node in graph.node:
        yield from node_tensors(node)


def node_tensors(node: onnx.NodeProto) -> Iterator[StoredTensor]:
    """The tensor attributes of ``node``, those of the graphs in its attributes included."""
    owner = node.name or "".join(node.output[:1])
    for attribute in node.attribute:
        if attribute.HasField("t"):
            yield StoredTensor(attribute.t, owner)
        yield from (StoredTensor(tensor, owner) for tensor in attribute.tensors)
        for graph in (*([attribute.g] if attribute.HasField("g") else []), *attribute.graphs):
            yield from stored_tensors(graph)


def model_tensors(model: onnx.ModelProto) -> Iterator[StoredTensor]:
    """Every stored tensor of the model: main graph, then model-local functions."""
    yield from stored_tensors(model.graph)
    for function in model.functions:
        for node in function.node:
            yield from node_tensors(node)


def embed_external_data(model: onnx.ModelProto, folder: Path | None) -> tuple[list[Problem], list[bytes]]:
    """Read the tensors that ``model`` stores in files below ``folder`` into the message itself.

    Returns the problems found, and the bytes read in graph order. ``folder`` is None for a model that came without a
    path. Nothing outside ``folder`` is opened, whether by an absolute path, ``..`` or a symbolic link.
    """
    problems: list[Problem] = []
    read: list[bytes] = []
    for stored in model_tensors(model):
        tensor = stored.tensor
        if not external_data_helper.uses_external_data(tensor):
            continue
        entries = {entry.key: entry.value for entry in tensor.external_data}
        location = entries.get("location", "")
        fault = _location_fault(location, folder)
        if fault is not None:
            problems.append(Problem(stored.owner, "", 0, *fault))
            continue
        try:
            external_data_helper.load_external_data_for_tensor(tensor, str(folder))
        except (ValueError, OSError, onnx.checker.ValidationError) as error:
            reason = f"its data in the external file {location!r} cannot be read: {error}"
            problems.append(
                Problem(stored.owner, "", 0, reason, "copy the file again from where the model was exported")
            )
            continue
        # Older versions of the helper leave these marks, and later readers would look for the file again.
        tensor.data_location = onnx.TensorProto.DEFAULT
        del tensor.external_data[:]
        read.append(tensor.raw_data)
    return problems, read


def _location_fault(location: str, folder: Path | None) -> tuple[str, str] | None:
    """Why ``location`` may not be read, and the remedy; None if it may."""
    if folder is None:
        return (
            f"its data are in the external file {location!r}, but the model was given without a folder",
            "pass the path of the model file, or load it with onnx.load(path) first",
        )
    root = folder.resolve()
    try:
        target = (root / location).resolve()
    except (OSError, ValueError) as error:
        return f"the external file name {location!r} is invalid: {error}", _STORE_ANEW
    if not location or Path(location).is_absolute() or not target.is_relative_to(root):
        return (
            f"the external file {location!r} lies outside the folder of the model; only files beside it are read",
            "copy the file beside the model and " + _STORE_ANEW,
        )
    if not target.is_file():
        return f"the external file {location!r} is missing beside the model", f"copy it to {root}"
    return None


def tensor_problem(stored: StoredTensor) -> Problem | None:
    """What is wrong with the tensor's data: wrong amount, unknown type, or weights that are not finite.

    A single such number may be a legal constant (the open end of a Clip, a NaN guard) and is left to the lowering.
    """
    tensor = stored.tensor
    shape = tuple(tensor.dims)
    fault = None
    if any(size < 0 for size in shape):
        fault = f"the tensor {tensor.name!r} declares the negative size {list(shape)}"
    # An element takes at least one bit, so this bounds memory before numpy is asked for an array.
    elif math.prod(shape) > 8 * tensor.ByteSize():
        fault = (
            f"the tensor {tensor.name!r} declares {list(shape)} = {math.prod(shape):,} elements but holds "
            f"only {tensor.ByteSize():,} bytes"
        )
    else:
        try:
            values = numpy_helper.to_array(tensor)
        except (ValueError, TypeError, KeyError) as error:
            fault = f"the tensor {tensor.name!r} of shape {list(shape)} cannot be read: {error}"
        else:
            if values.size > 1 and _is_float(tensor.data_type):
                with np.errstate(invalid="ignore"):  # a signalling NaN warns in the cast
                    finite = np.isfinite(values.astype(np.float64))
                if not finite.all():
                    count = int(values.size - np.count_nonzero(finite))
                    return Problem(
                        stored.owner,
                        "",
                        0,
                        f"{count} of the {values.size} numbers of the tensor {tensor.name!r} are NaN or infinite",
                        "the training diverged or the file is damaged: export a checkpoint with finite weights",
                    )
    return Problem(stored.owner, "", 0, fault, _STORE_ANEW) if fault else None


def _is_float(data_type: int) -> bool:
    types = onnx.TensorProto
    return data_type in (types.FLOAT, types.DOUBLE, types.FLOAT16, types.BFLOAT16)


def densify(graph: onnx.GraphProto) -> list[Problem]:
    """Make the sparse tensors of ``graph`` dense, and those of the graphs inside it; returns the problems found."""
    problems = _densify_initializers(graph) + _densify_constants(graph)
    for node in graph.node:
        for inner in inner_graphs(node):
            problems += densify(inner)
    return problems


def _densify_initializers(graph: onnx.GraphProto) -> list[Problem]:
    """Replace the sparse initializers of ``graph`` by dense ones; returns the problems of those that cannot be."""
    problems: list[Problem] = []
    for sparse in graph.sparse_initializer:
        name = sparse.values.name
        try:
            dense = _dense(sparse)
        except (ValueError, TypeError, KeyError) as error:
            reason = f"the sparse initializer cannot be read: {error}"
            problems.append(Problem(name, "", 0, reason, "store it as a dense initializer"))
            continue
        graph.initializer.append(numpy_helper.from_array(dense, name))
    del graph.sparse_initializer[:]
    return problems


def _densify_constants(graph: onnx.GraphProto) -> list[Problem]:
    """Replace the ``sparse_value`` of Constant nodes by a dense ``value``; returns the problems found."""
    problems: list[Problem] = []
    for node in graph.node:
        for attribute in node.attribute:
            if not attribute.HasField("sparse_tensor"):
                continue
            try:
                dense = _dense(attribute.sparse_tensor)
            except (ValueError, TypeError, KeyError) as error:
                reason = f"its sparse tensor cannot be read: {error}"
                problems.append(Problem(node.name or node.output[0], node.op_type, 0, reason, "store it densely"))
                continue
            attribute.CopyFrom(onnx.helper.make_attribute("value", numpy_helper.from_array(dense)))
    return problems


def _dense(sparse: onnx.SparseTensorProto) -> np.ndarray:
    """The array of a COO tensor: indices are [nnz] into the flattened array, or [nnz, rank] (as ONNX defines)."""
    shape = tuple(sparse.dims)
    values = numpy_helper.to_array(sparse.values)
    indices = numpy_helper.to_array(sparse.indices)
    if any(size < 0 for size in shape) or math.prod(shape) * values.itemsize > PROTOBUF_LIMIT:
        raise ValueError(f"its dense size {list(shape)} is not below 2 GiB")
    if indices.ndim == 2:
        indices = np.ravel_multi_index(tuple(indices.T), shape)
    if indices.shape != values.shape or (indices.size and not 0 <= indices.min() <= indices.max() < math.prod(shape)):
        raise ValueError(f"{values.size} values with indices that do not fit the shape {list(shape)}")
    dense = np.zeros(math.prod(shape), values.dtype)
    dense[indices] = values
    return dense.reshape(shape)
