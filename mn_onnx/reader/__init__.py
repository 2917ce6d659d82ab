"""Reads a model from a path, bytes or a message, and refuses with all reasons what is no well-formed ONNX model."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import onnx

from mn_onnx.errors import ModelRefused, Problem, UsageError
from mn_onnx.reader.formats import PROTOBUF_LIMIT, decode
from mn_onnx.reader.functions import inline_functions
from mn_onnx.reader.structure import interface_problems, node_problems, opset_problems, opset_versions, sort_nodes
from mn_onnx.reader.tensors import (
    densify,
    embed_external_data,
    model_tensors,
    tensor_problem,
)

ModelSource = str | os.PathLike[str] | bytes | onnx.ModelProto


@dataclass(frozen=True, eq=False)
class ReadModel:
    """A well-formed model.

    ``model``: self-contained (external data read in, sparse tensors made dense), nodes sorted, functions inlined.
    ``original``: the same before inlining, for other runtimes. ``name``: the file name, or a word for the source.
    ``sha256``: of the file's bytes, followed by those of its external data if it has any.
    """

    model: onnx.ModelProto
    original: onnx.ModelProto
    name: str
    sha256: str


def read_model(source: ModelSource) -> ReadModel:
    """Read and check a model.

    ``source``: a path (binary ONNX, optionally gzipped; ONNX text, JSON or text protobuf), the bytes of such a file, or
    a message, which is not changed. External data are read only from below the folder of the path.

    Raises `UsageError` if the path is missing, unreadable or a folder, `ModelRefused` with every problem found if the
    model is not well formed. Whether its operators are supported is the importer's question, not asked here.
    """
    folder = None
    if isinstance(source, onnx.ModelProto):
        name = source.graph.name or "model"
        digest = hashlib.sha256(source.SerializeToString(deterministic=True))
        original = onnx.ModelProto()
        original.CopyFrom(source)
    else:
        if isinstance(source, bytes):
            name, data = "model", source
        else:
            path = Path(source)
            name, folder, data = path.name, path.parent, _read_file(path)
        digest = hashlib.sha256(data)
        original = decode(data, name)
    problems, external = embed_external_data(original, folder)
    for part in external:
        digest.update(part)
    problems += opset_problems(original)
    if original.ir_version < 1:
        problems.append(Problem("", "", 0, "the model has no IR version", "export it again with an ONNX exporter"))
    if original.ByteSize() > PROTOBUF_LIMIT:
        reason = "the model and its weights have more than 2 GiB, the limit of protobuf"
        problems.append(Problem("", "", 0, reason, "export a smaller network, or float16 weights"))
    # Damaged tensors and unknown opsets would only make the steps below stumble over the same faults.
    problems += _tensor_problems(original)
    if problems:
        raise ModelRefused(problems)
    _lower_ir_version(original)
    problems += densify(original.graph)
    model = _inline_functions(original) if original.functions else original
    problems += interface_problems(model.graph)
    problems += sort_nodes(model.graph, opset_versions(model))
    problems += node_problems(model.graph, model)
    if problems:
        raise ModelRefused(problems)
    return ReadModel(model, original, name, digest.hexdigest())


def _read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except IsADirectoryError as error:
        reason = f"{path} is a folder; pass the .onnx file (TensorFlow models: convert with tf2onnx)"
        raise UsageError(reason) from error
    except FileNotFoundError as error:
        raise UsageError(f"there is no model file {path}") from error
    except OSError as error:
        raise UsageError(f"cannot read the model file {path}: {error.strerror}") from error
    except ValueError as error:  # a path with a null character
        raise UsageError(f"{str(path)!r} is no path of a model file: {error}") from error


def _tensor_problems(model: onnx.ModelProto) -> list[Problem]:
    found = (tensor_problem(stored) for stored in model_tensors(model) if stored.tensor.data_location == 0)
    return [problem for problem in found if problem is not None]


def _lower_ir_version(model: onnx.ModelProto) -> None:
    """Declare the oldest file format that has the model's operator sets, if its own is newer than the installed onnx's.

    The format version says what a file may contain; what this one does contain has been parsed and is checked.
    """
    if model.ir_version > onnx.IR_VERSION:
        model.ir_version = onnx.helper.find_min_ir_version_for(list(model.opset_import), ignore_unknown=True)


def _inline_functions(model: onnx.ModelProto) -> onnx.ModelProto:
    try:
        return inline_functions(model)
    except (RuntimeError, ValueError, onnx.checker.ValidationError) as error:
        names = ", ".join(f"{function.domain}::{function.name}" for function in model.functions)
        reason = f"its model-local functions ({names}) cannot be inlined: {str(error).splitlines()[0]}"
        raise ModelRefused([Problem("", "", 0, reason, "export without functions, or inline them")]) from error
