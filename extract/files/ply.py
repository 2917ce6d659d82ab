"""PLY files (Turk, "The PLY polygon file format", 1994): polygons with values per face, binary or text."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.files.polygon_mesh import MeshFileError, PolygonMesh, chunks
from mn_onnx.ir.kernel import threaded_kernel

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_NAMES = {"u1": "uchar", "i4": "int", "f4": "float", "f8": "double"}
_INDEX_LISTS = ("vertex_indices", "vertex_index")


def write_ply(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:
    """Binary little-endian PLY; ``float64`` keeps coordinates and columns in double precision."""
    real = "<f8" if float64 else "<f4"
    sizes = np.diff(mesh.offsets)
    count_type = "<u1" if sizes.max(initial=0) <= 255 else "<i4"
    row = np.dtype([(name, _column_type(name, values, real)) for name, values in mesh.columns.items()])
    coordinate = _NAMES[real[1:]]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment exact level set by mn-onnx",
        f"element vertex {len(mesh.vertices)}",
        *(f"property {coordinate} {axis}" for axis in "xyz"),
        f"element face {mesh.n_polygons}",
        f"property list {_NAMES[count_type[1:]]} int vertex_indices",
        *(f"property {_NAMES[row[name].str[1:]]} {name}" for name in mesh.columns),
        "end_header\n",
    ]
    stream.write("\n".join(header).encode())
    for rows in chunks(len(mesh.vertices)):
        stream.write(mesh.vertices[rows].astype(real).tobytes())
    for rows in chunks(mesh.n_polygons):
        offsets = mesh.offsets[rows.start : rows.stop + 1]
        values = np.empty(offsets.size - 1, row)
        for name, column in mesh.columns.items():
            values[name] = column[rows]
        corners = mesh.corners[offsets[0] : offsets[-1]].astype("<i4")
        counts = sizes[rows].astype(count_type)
        stream.write(_face_records(counts, corners, values).tobytes())


def _column_type(name: str, values: NDArray[Any], real: str) -> str:
    if np.issubdtype(values.dtype, np.floating):
        return real
    if values.dtype == np.bool_:
        return "<u1"
    if np.issubdtype(values.dtype, np.integer):
        if values.size and (values.min() < np.iinfo(np.int32).min or values.max() > np.iinfo(np.int32).max):
            raise MeshFileError(f"attribute {name} has integers beyond 32 bits; .ply needs them as floats")
        return "<i4"
    raise MeshFileError(f"attribute {name} is {values.dtype}; .ply holds integers and floats")


def _face_records(counts: NDArray[Any], corners: NDArray[Any], values: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes of faces: each its corner count, its corners, its row of values."""
    head, item, tail = counts.itemsize, corners.itemsize, values.itemsize
    lengths = head + item * counts.astype(np.int64) + tail
    ends = np.cumsum(lengths)
    data = np.empty(int(ends[-1]), np.uint8)
    is_corner = np.ones(data.size, np.bool_)
    for part, places in (
        (counts, (ends - lengths)[:, None] + np.arange(head)),
        (values, (ends - tail)[:, None] + np.arange(tail)),
    ):
        if places.size:
            data[places] = part.view(np.uint8).reshape(places.shape)
            is_corner[places] = False
    data[is_corner] = corners.view(np.uint8)
    return data


@dataclass
class _Element:
    """One element of a header: its scalar properties (name, type) in order and the place of its list among them."""

    name: str
    count: int
    scalars: list[tuple[str, str]] = field(default_factory=list)
    list_name: str = ""
    list_types: tuple[str, str] = ("", "")
    n_before_list: int = 0


@dataclass
class _Header:
    order: str
    elements: list[_Element]
    size: int


def _read_header(path: Path, data: bytes) -> _Header:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise MeshFileError(f"{path} has no PLY header")
    newline = data.find(b"\n", end)
    header = _Header("", [], newline + 1 if newline >= 0 else len(data))
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_]:
                orders = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
                if kind not in orders:
                    raise MeshFileError(f"{path}: unknown PLY format {kind}; known are {', '.join(orders)}")
                header.order = orders[kind]
            case ["element", name, count]:
                header.elements.append(_Element(name, int(count)))
            case ["property", "list", count_type, item_type, name] if header.elements:
                element = header.elements[-1]
                if element.list_name:
                    raise MeshFileError(f"{path}: element {element.name} has two lists; write it with one")
                element.list_name = name
                element.list_types = (_type(path, count_type), _type(path, item_type))
                element.n_before_list = len(element.scalars)
            case ["property", kind, name] if header.elements:
                header.elements[-1].scalars.append((name, _type(path, kind)))
    if not header.order:
        raise MeshFileError(f"{path}: the PLY header names no format")
    return header


def _type(path: Path, name: str) -> str:
    if name not in _TYPES:
        raise MeshFileError(f"{path}: unknown PLY type {name}; known are {', '.join(_TYPES)}")
    return _TYPES[name]


@threaded_kernel
def _scan_list_counts(
    data: NDArray[np.uint8],
    begin: int,
    before: int,
    width: int,
    big: bool,
    item: int,
    after: int,
    counts: NDArray[np.int64],
) -> int:
    """Read the count of each record's list; returns where the last record ends, -1 if the data end earlier."""
    at = begin
    for record in range(counts.size):
        at += before
        if at + width > data.size:
            return -1
        count = 0
        for byte in range(width):
            count = count * 256 + data[at + byte if big else at + width - 1 - byte]
        counts[record] = count
        at += width + item * count + after
        if at > data.size:
            return -1
    return at


def _read_binary(
    path: Path, header: _Header, element: _Element, data: NDArray[np.uint8], begin: int
) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64], int]:
    """Columns by name, the list's items among them; the list's counts; the end of the element."""

    def row_type(scalars: list[tuple[str, str]]) -> np.dtype[Any]:
        return np.dtype([(name, header.order + kind) for name, kind in scalars])

    truncated = MeshFileError(f"{path} ends within its element {element.name}: the file is not complete")
    if not element.list_name:
        row = row_type(element.scalars)
        end = begin + row.itemsize * element.count
        if end > data.size:
            raise truncated
        table = data[begin:end].view(row) if row.itemsize else np.empty(0, row)
        return {name: table[name] for name, _ in element.scalars}, np.empty(0, np.int64), end

    before = row_type(element.scalars[: element.n_before_list]).itemsize
    after = row_type(element.scalars[element.n_before_list :]).itemsize
    width, item = (np.dtype(kind).itemsize for kind in element.list_types)
    counts = np.empty(element.count, np.int64)
    end = _scan_list_counts(data, begin, before, width, header.order == ">", item, after, counts)
    if end < 0:
        raise truncated
    lengths = before + width + item * counts + after
    starts = np.cumsum(lengths) - lengths
    is_item = np.ones(end - begin, np.bool_)
    for shift in range(before + width):
        is_item[starts + shift] = False
    for shift in range(after):
        is_item[starts + lengths - 1 - shift] = False
    items = data[begin:end][is_item].view(header.order + element.list_types[1])
    return {element.list_name: items}, counts, end


def _read_text(path: Path, element: _Element, lines: list[bytes]) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
    if len(lines) < element.count:
        raise MeshFileError(f"{path} ends within its element {element.name}: the file is not complete")
    rows = [line.split() for line in lines]
    n_before = element.n_before_list
    if element.list_name:
        counts = np.array([int(row[n_before]) for row in rows], np.int64)
        items = [value for row in rows for value in row[n_before + 1 : n_before + 1 + int(row[n_before])]]
        return {element.list_name: np.array(items, np.float64)}, counts
    table = np.array(rows, np.float64).reshape(element.count, -1)
    return {name: table[:, column] for column, (name, _) in enumerate(element.scalars)}, np.empty(0, np.int64)


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices [v, 3], offsets [p + 1] and corners [c] of the polygons of a PLY file.

    Raises MeshFileError for a file that is damaged or has no vertices or faces.
    """
    content = path.read_bytes()
    header = _read_header(path, content)
    text = header.order == "ascii"
    lines = [line for line in content[header.size :].splitlines() if line.strip()] if text else []
    data = np.frombuffer(content, np.uint8)
    at = 0 if text else header.size
    columns: dict[str, dict[str, NDArray[Any]]] = {}
    sizes = np.empty(0, np.int64)
    for element in header.elements:
        if text:
            columns[element.name], counts = _read_text(path, element, lines[at : at + element.count])
            at += element.count
        else:
            columns[element.name], counts, at = _read_binary(path, header, element, data, at)
        if element.name == "face":
            sizes = counts
    corners = next((columns["face"][name] for name in _INDEX_LISTS if name in columns.get("face", {})), None)
    if corners is None or not {"x", "y", "z"} <= columns.get("vertex", {}).keys():
        raise MeshFileError(f"{path} has no vertices with x, y, z or no faces with vertex_indices")
    vertices = np.stack([columns["vertex"][axis].astype(np.float64) for axis in "xyz"], axis=1)
    return vertices, np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)]), corners.astype(np.int64)
