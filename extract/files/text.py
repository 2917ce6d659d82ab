"""OBJ and OFF files: polygons as text."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.files.polygon_mesh import MeshFileError, PolygonMesh, chunks

Arrays = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]


def _write_rows(stream: BinaryIO, pattern: str, rows: NDArray[np.float64] | Indices) -> None:
    for part in chunks(len(rows)):
        chunk = rows[part]
        stream.write((pattern * len(chunk) % tuple(chunk.reshape(-1).tolist())).encode())


def _write_polygons(stream: BinaryIO, mesh: PolygonMesh, start: str, first_index: int) -> None:
    """One line per polygon; ``start`` may tell the number of corners as ``{n}``."""
    sizes = np.diff(mesh.offsets)
    patterns = {n: start.format(n=n) + " %d" * n + "\n" for n in np.unique(sizes).tolist()}
    for part in chunks(mesh.n_polygons):
        corners = mesh.corners[mesh.offsets[part.start] : mesh.offsets[part.stop]] + first_index
        lines = "".join([patterns[n] for n in sizes[part].tolist()])
        stream.write((lines % tuple(corners.tolist())).encode())


def _coordinates(float64: bool) -> str:
    """A line of three numbers with the digits that give back the same float."""
    return " ".join(["%.17g" if float64 else "%.9g"] * 3) + "\n"


def write_obj(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:
    """Wavefront OBJ: vertices and faces."""
    stream.write(b"# exact level set by mn-onnx\n")
    _write_rows(stream, "v " + _coordinates(float64), mesh.vertices)
    _write_polygons(stream, mesh, "f", 1)


def write_off(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:
    """Geomview OFF: vertices and faces."""
    stream.write(f"OFF\n{len(mesh.vertices)} {mesh.n_polygons} 0\n".encode())
    _write_rows(stream, _coordinates(float64), mesh.vertices)
    _write_polygons(stream, mesh, "{n}", 0)


def _arrays(vertices: list[list[float]], polygons: list[list[int]]) -> Arrays:
    offsets = np.zeros(len(polygons) + 1, np.int64)
    np.cumsum([len(polygon) for polygon in polygons], out=offsets[1:])
    corners = np.fromiter((corner for polygon in polygons for corner in polygon), np.int64, int(offsets[-1]))
    return np.array(vertices, np.float64).reshape(-1, 3), offsets, corners


def read_obj(path: Path) -> Arrays:
    """Vertices, offsets and corners of an OBJ file; texture coordinates and normals are passed over.

    Raises MeshFileError for a line that is neither.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words or words[0] not in ("v", "f"):
                continue
            try:
                if words[0] == "v":
                    vertices.append([*map(float, words[1:4])])
                else:
                    references = [int(word.partition("/")[0]) for word in words[1:]]
                    polygons.append([index - 1 if index > 0 else len(vertices) + index for index in references])
            except ValueError as error:
                raise MeshFileError(f"{path}, line {number}: {error}") from error
    return _arrays(vertices, polygons)


def read_off(path: Path) -> Arrays:
    """Vertices, offsets and corners of an OFF file; colours are passed over.

    Raises MeshFileError for a damaged file.
    """
    with path.open(encoding="utf-8", errors="replace") as stream:
        rows = [words for line in stream if (words := line.partition("#")[0].split())]
    if not rows or rows[0][0] != "OFF":
        raise MeshFileError(f"{path} does not begin with OFF; of that family only plain OFF is read")
    rows[0] = rows[0][1:]
    rows = rows if rows[0] else rows[1:]
    try:
        n_vertices, n_polygons = int(rows[0][0]), int(rows[0][1])
        if len(rows) < 1 + n_vertices + n_polygons:
            raise MeshFileError(f"{path} ends after {len(rows) - 1} of {n_vertices + n_polygons} vertices and faces")
        faces = rows[1 + n_vertices : 1 + n_vertices + n_polygons]
        polygons = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in faces]
        if any(len(polygon) != int(row[0]) for polygon, row in zip(polygons, faces, strict=True)):
            raise MeshFileError(f"{path} has faces with fewer corners than they announce")
        return _arrays([[*map(float, row[:3])] for row in rows[1 : 1 + n_vertices]], polygons)
    except (ValueError, IndexError) as error:
        raise MeshFileError(f"{path} is not a valid OFF file: {error}") from error
