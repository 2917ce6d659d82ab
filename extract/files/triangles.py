"""STL, GLB and 3MF files: triangles only."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO, cast
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.files.polygon_mesh import MeshFileError, PolygonMesh, chunks

_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_3MF_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_3MF_MODEL = "3D/3dmodel.model"
_3MF_PARTS = {
    "[Content_Types].xml": '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
    "_rels/.rels": '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    f'<Relationship Target="/{_3MF_MODEL}" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
}
_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_stl(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:  # noqa: ARG001 - always float32
    """Binary STL, with the exact normals."""
    stream.write(b"exact level set by mn-onnx".ljust(80) + np.uint32(mesh.n_polygons).tobytes())
    triangles = mesh.triangles
    for part in chunks(mesh.n_polygons):
        rows = np.zeros(part.stop - part.start, _STL_TRIANGLE)
        rows["normal"] = mesh.normals[part]
        rows["corners"] = mesh.vertices[triangles[part]]
        stream.write(rows.tobytes())


def write_glb(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:  # noqa: ARG001 - always float32
    """Binary glTF, through trimesh."""
    import trimesh

    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False, validate=False)
    stream.write(cast(bytes, shape.export(file_type="glb", include_normals=False)))


def write_3mf(stream: BinaryIO, mesh: PolygonMesh, *, float64: bool) -> None:
    """3MF core: one object. Written here because trimesh's files differ from run to run."""
    number = "%.17g" if float64 else "%.9g"
    vertex = f'<vertex x="{number}" y="{number}" z="{number}"/>\n'
    triangle = '<triangle v1="%d" v2="%d" v3="%d"/>\n'
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in _3MF_PARTS.items():
            archive.writestr(_zip_entry(name), text)
        with archive.open(_zip_entry(_3MF_MODEL), "w", force_zip64=True) as model:
            model.write(
                f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xmlns="{_3MF_CORE}"><resources>'
                '<object id="1" type="model"><mesh><vertices>\n'.encode()
            )
            for pattern, rows, separator in (
                (vertex, mesh.vertices, b"</vertices><triangles>\n"),
                (triangle, mesh.triangles, b"</triangles></mesh></object></resources>"),
            ):
                for part in chunks(len(rows)):
                    chunk = rows[part]
                    model.write((pattern * len(chunk) % tuple(chunk.reshape(-1).tolist())).encode())
                model.write(separator)
            model.write(b'<build><item objectid="1"/></build></model>\n')


def _zip_entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _ZIP_EPOCH)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def read_3mf(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices, offsets and corners of all objects of a 3MF file, each where it stands in its own frame.

    Raises MeshFileError for a damaged file, or one that places its objects by transforms.
    """
    vertices: list[tuple[float, ...]] = []
    corners: list[int] = []
    first = 0
    try:
        with zipfile.ZipFile(path) as archive, archive.open(_3MF_MODEL) as model:
            for _, element in ElementTree.iterparse(model):
                match element.tag.rpartition("}")[2]:
                    case "vertex":
                        vertices.append(tuple(float(element.attrib[axis]) for axis in "xyz"))
                    case "triangle":
                        corners.extend(first + int(element.attrib[corner]) for corner in ("v1", "v2", "v3"))
                    case "mesh":
                        first = len(vertices)
                    case "item" | "component" if "transform" in element.attrib:
                        raise MeshFileError(f"{path} places its objects by transforms; save it with them applied")
                element.clear()
    except (zipfile.BadZipFile, KeyError, ElementTree.ParseError, ValueError) as error:
        raise MeshFileError(f"{path} is not a valid 3MF file: {error}") from error
    offsets = np.arange(len(corners) // 3 + 1, dtype=np.int64) * 3
    return np.array(vertices, np.float64).reshape(-1, 3), offsets, np.array(corners, np.int64)
