"""Mesh files: the format follows the file's extension."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices, resolve_threads
from mn_onnx.extract.files.ply import read_ply, write_ply
from mn_onnx.extract.files.polygon_mesh import MeshFileError, PolygonMesh
from mn_onnx.extract.files.text import read_obj, read_off, write_obj, write_off
from mn_onnx.extract.files.triangles import read_3mf, write_3mf, write_glb, write_stl
from mn_onnx.extract.files.whole import place_problems, written_whole
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import first_of_equal_keys

__all__ = ["WRITABLE", "MeshFileError", "check_mesh_options", "read_mesh", "write_mesh"]


class _Writer(Protocol):
    def __call__(self, stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None: ...


@dataclass(frozen=True)
class _Format:
    """How a format is written, and what it can hold beside triangles in float32."""

    write: _Writer
    polygons: bool = False
    float64: bool = False
    attributes: bool = False


_FORMATS: Mapping[str, _Format] = {
    ".ply": _Format(write_ply, polygons=True, float64=True, attributes=True),
    ".obj": _Format(write_obj, polygons=True, float64=True),
    ".off": _Format(write_off, polygons=True, float64=True),
    ".stl": _Format(write_stl),
    ".glb": _Format(write_glb),
    ".3mf": _Format(write_3mf, float64=True),
}

WRITABLE = tuple(_FORMATS)
"""The extensions that `write_mesh` knows."""

_Arrays = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]

_READERS: Mapping[str, Callable[[Path], _Arrays]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".off": read_off,
    ".3mf": read_3mf,
}


def check_mesh_options(path: str | os.PathLike[str], *, float64: bool = False, attributes: Iterable[str] = ()) -> None:
    """Raise MeshFileError, with all reasons, if `write_mesh` could not write ``path`` with these options.

    To be asked before a long computation.
    """
    target = Path(path)
    form = _FORMATS.get(target.suffix.lower())
    problems = []
    if form is None:
        found = f"ends in {target.suffix}" if target.suffix else "has no extension"
        problems.append(f"{target} {found}; a mesh is written to {', '.join(WRITABLE)}")
    else:
        if float64 and not form.float64:
            problems.append(
                f"{target.suffix} holds coordinates in float32 only; for float64 write to {_holding('float64')}"
            )
        if list(attributes) and not form.attributes:
            problems.append(f"{target.suffix} holds no values per face; write to {_holding('attributes')}")
    problems += place_problems(target)
    if problems:
        raise MeshFileError("; ".join(problems))


def _holding(ability: str) -> str:
    return ", ".join(extension for extension, form in _FORMATS.items() if getattr(form, ability))


def write_mesh(
    surface: Surface,
    path: str | os.PathLike[str],
    *,
    float64: bool = False,
    triangulate: bool = False,
    attributes: Iterable[str] = (),
) -> None:
    """Write ``surface`` in the format of the extension of ``path``.

    .ply, .obj and .off hold polygons, .stl, .glb and .3mf triangles. The file appears whole or not at all.

    ``float64``: coordinates in double precision; otherwise they are rounded to float32.
    ``triangulate``: triangles in any format.
    ``attributes``: values to write per face, in .ply: ``normals``, ``errors``, or names of ``surface.attributes``.

    Raises MeshFileError for an unknown extension, a format that cannot hold what is asked, an unknown attribute, or a
    folder that does not exist; OSError if writing fails.
    """
    target = Path(path)
    names = list(attributes)
    check_mesh_options(target, float64=float64, attributes=names)
    form = _FORMATS[target.suffix.lower()]
    mesh = _polygon_mesh(surface, triangulate or not form.polygons, _columns(surface, names))
    with written_whole(target) as stream:
        form.write(stream, mesh, float64=float64)


def _columns(surface: Surface, names: list[str]) -> dict[str, NDArray[Any]]:
    available = {"normals": surface.normals, "errors": surface.errors, **surface.attributes}
    unknown = [name for name in names if name not in available]
    if unknown:
        raise MeshFileError(f"no attribute {', '.join(unknown)}; there are {', '.join(available)}")
    columns: dict[str, NDArray[Any]] = {}
    for name in names:
        values = available[name]
        if name == "normals":
            columns.update(zip(("nx", "ny", "nz"), values.T, strict=True))
        elif values.ndim == 1:
            columns[name] = values
        else:
            columns.update(
                (f"{name}_{index}", column) for index, column in enumerate(values.reshape(len(values), -1).T)
            )
    return columns


def _polygon_mesh(surface: Surface, triangulate: bool, columns: dict[str, NDArray[Any]]) -> PolygonMesh:
    if not triangulate:
        return PolygonMesh(surface.vertices, surface.offsets, surface.corners, surface.normals, columns)
    triangles = surface.triangles()
    owners = surface.triangle_polygons()
    return PolygonMesh(
        surface.vertices,
        np.arange(len(triangles) + 1, dtype=np.int64) * 3,
        triangles.reshape(-1),
        surface.normals[owners],
        {name: values[owners] for name, values in columns.items()},
    )


def read_mesh(path: str | os.PathLike[str], *, threads: int | None = None) -> Surface:
    """Read a mesh file as a `Surface` whose gradients are the unit normals of its polygons.

    .ply, .obj, .off (polygons kept as they are) and .3mf are read as written; whatever else trimesh reads (.stl,
    .glb, ...) comes as triangles, in which equal vertices become one, since such files repeat vertices.

    Raises MeshFileError for a file that is damaged or of unknown kind, FileNotFoundError if there is none.
    """
    source = Path(path)
    if not source.is_file():
        raise FileNotFoundError(f"there is no mesh file {source}")
    reader = _READERS.get(source.suffix.lower())
    try:
        if reader is not None:
            return Surface.from_polygons(*reader(source), threads=threads)
        return _from_loose_triangles(*_read_with_trimesh(source), threads)
    except (ValueError, IndexError) as error:
        raise MeshFileError(f"{source} holds no valid mesh: {error}") from error


def _read_with_trimesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import trimesh

    known = sorted({*trimesh.available_formats(), *(extension[1:] for extension in _READERS)})
    if path.suffix.lower()[1:] not in known:
        raise MeshFileError(f"{path}: unknown kind of mesh file; those that can be read are .{', .'.join(known)}")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # its readers raise whatever a damaged file leads to
        raise MeshFileError(f"{path} cannot be read: {error}") from error
    if not len(mesh.faces):
        raise MeshFileError(f"{path} holds no triangles: it is empty or damaged")
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def _from_loose_triangles(vertices: NDArray[np.float64], triangles: NDArray[np.int64], threads: int | None) -> Surface:
    """The surface of triangles that may repeat vertices, without those of fewer than three different corners."""
    corners = _merged_vertices(vertices, resolve_threads(threads))[triangles]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    used, numbers = np.unique(corners[whole], return_inverse=True)
    offsets = np.arange(np.count_nonzero(whole) + 1) * 3
    return Surface.from_polygons(vertices[used], offsets, numbers.reshape(-1), threads=threads)


def _merged_vertices(vertices: NDArray[np.float64], threads: int) -> Indices:
    """For each vertex the first one with exactly the same coordinates, [v]."""
    words = np.ascontiguousarray(vertices + 0.0).view(np.uint64)  # + 0.0 turns -0.0 into 0.0
    same_xy = first_of_equal_keys(np.ascontiguousarray(words[:, :2]), threads).astype(np.uint64)
    return first_of_equal_keys(np.stack([same_xy, words[:, 2]], axis=1), threads)
