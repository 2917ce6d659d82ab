"""From the bytes of a file to an ONNX protobuf message: binary, gzip, ONNX text, JSON and text protobuf."""

from __future__ import annotations

import gzip
import io
import zlib

import onnx
from google.protobuf import json_format, text_format
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

from mn_onnx.errors import ModelRefused, Problem

PROTOBUF_LIMIT = 2**31 - 1
"""Protobuf messages are below 2 GiB; larger models keep their weights in external files."""

_EXPORT = "export the network to ONNX (torch.onnx.export, tf2onnx, jax2onnx, skl2onnx) and pass that file"

# Files that people pass instead of a model: leading bytes, what the file is, what to do.
_OTHER_FILES: tuple[tuple[bytes, str, str], ...] = (
    (
        b"version https://git-lfs",
        "a Git LFS pointer, not the model itself",
        "run `git lfs pull` where the file is from",
    ),
    (b"PK\x03\x04", "a zip archive, as PyTorch checkpoints (.pt, .pth), Keras files and .npz are", _EXPORT),
    (b"\x89HDF", "an HDF5 file, as Keras weights are", _EXPORT),
    (b"\x80\x02", "a Python pickle, as old PyTorch checkpoints are", _EXPORT),
    (b"\x80\x03", "a Python pickle", _EXPORT),
    (b"\x80\x04", "a Python pickle", _EXPORT),
    (b"\x80\x05", "a Python pickle", _EXPORT),
    (b"\x93NUMPY", "a NumPy array", _EXPORT),
    (b"ORTM", "a model in onnxruntime's own ORT format", "pass the ONNX file that it was converted from"),
    (b"<!DOCTYPE", "a web page, probably of a failed download", "download the file itself"),
    (b"<html", "a web page, probably of a failed download", "download the file itself"),
    (b"ply\n", "a PLY mesh", "pass the network; meshes are checked with `mn-onnx verify MESH MODEL`"),
)


def decode(data: bytes, name: str) -> onnx.ModelProto:
    """The model in ``data``; ``name`` is how messages call it.

    Raises `ModelRefused` where ``data`` is no ONNX model, saying what it looks like.
    """
    if data[:2] == b"\x1f\x8b":
        data = _decompress(data, name)
    if not data:
        raise _refused(name, "the file is empty (0 bytes)", "export or download it again")
    for magic, what, remedy in _OTHER_FILES:
        if data.startswith(magic) or (data[4:8] == magic):
            raise _refused(name, f"this is {what}", remedy)
    text = _as_text(data)
    model = _decode_text(text, name) if text is not None else _decode_binary(data, name)
    if not model.HasField("graph"):
        raise _refused(name, "this is not an ONNX model (no graph in it)", "pass a file written by an ONNX exporter")
    return model


def _refused(name: str, reason: str, remedy: str) -> ModelRefused:
    return ModelRefused([Problem(name, "", 0, reason, remedy)])


def _decompress(data: bytes, name: str) -> bytes:
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(PROTOBUF_LIMIT + 1)
    except (zlib.error, EOFError, OSError) as error:
        raise _refused(name, f"the gzip file is damaged ({error})", "compress or download it again") from error
    if len(content) > PROTOBUF_LIMIT:
        raise _refused(name, "the gzip file holds more than 2 GiB", "store the weights as external data")
    return content


def _as_text(data: bytes) -> str | None:
    """``data`` as text if it holds no control characters, as every binary model does."""
    if any(byte < 9 or 13 < byte < 32 for byte in data[:4096]):
        return None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return None


def _decode_text(text: str, name: str) -> onnx.ModelProto:
    start = text.lstrip()[:1]
    model = onnx.ModelProto()
    try:
        if start == "<":
            return onnx.parser.parse_model(text)
        if start == "{":
            json_format.Parse(text, model)
        else:
            text_format.Parse(text, model)
    except (json_format.ParseError, text_format.ParseError, onnx.parser.ParseError) as error:
        reason = f"this text file is no ONNX model ({_first_line(error)})"
        raise _refused(name, reason, "pass a file written by an ONNX exporter") from error
    return model


def _decode_binary(data: bytes, name: str) -> onnx.ModelProto:
    if len(data) > PROTOBUF_LIMIT:
        raise _refused(
            name, "the file has more than 2 GiB, the limit of protobuf", "store the weights as external data"
        )
    try:
        model: onnx.ModelProto = onnx.ModelProto.FromString(data)
    except DecodeError as error:
        reason = f"the file is damaged, cut off, or not an ONNX model ({_first_line(error)})"
        raise _refused(name, reason, "export or download it again") from error
    if not _is_text_valid(model):
        raise _refused(name, "the file is damaged: a name in it is not UTF-8 text", "export or download it again")
    return model


def _is_text_valid(message: Message) -> bool:
    """Whether all text fields are UTF-8; protobuf hands out those that are not as bytes."""
    for field, value in message.ListFields():
        parts = [value] if isinstance(value, (str, bytes, Message)) else value
        if field.type == FieldDescriptor.TYPE_STRING and any(isinstance(part, bytes) for part in parts):
            return False
        if field.type == FieldDescriptor.TYPE_MESSAGE and not all(_is_text_valid(part) for part in parts):
            return False
    return True


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
