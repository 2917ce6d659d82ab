"""The exact level set as the polygon soup that a perfect traversal would emit."""

from __future__ import annotations

import hashlib

import numpy as np

from mn_onnx.extract.soup import PolygonSoup
from oracle.level_set import LevelSet
from oracle.polytope import Point


def as_soup(exact: LevelSet) -> PolygonSoup:
    """``exact`` rounded to float64; the keys are digests of the exact positions."""
    polygons = [facet.vertices for facet in exact.facets]
    corners = [vertex for polygon in polygons for vertex in polygon]
    following = [vertex for polygon in polygons for vertex in polygon[1:] + polygon[:1]]
    faces = [next(iter(exact.box_faces(edge)), -1) for edge in zip(corners, following, strict=True)]
    return PolygonSoup(
        offsets=np.concatenate([[0], np.cumsum([len(polygon) for polygon in polygons], dtype=np.int64)]).astype(
            np.int64
        ),
        corners=np.arange(len(corners)),
        positions=np.array(corners, np.float64).reshape(-1, 3),
        keys=np.array([_key(corner) for corner in corners], np.uint64).reshape(-1, 2),
        box_faces=np.array(faces, np.int8),
        gradients=np.array([facet.gradient for facet in exact.facets], np.float64).reshape(-1, 3),
        errors=np.zeros(len(polygons)),
    )


def _key(vertex: Point) -> tuple[int, int]:
    digest = hashlib.sha256(repr(vertex).encode()).digest()
    return int.from_bytes(digest[:8], "little"), int.from_bytes(digest[8:16], "little")
