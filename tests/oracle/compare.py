"""Comparison of an extracted polygon soup with the exact level set, polygon by polygon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mn_onnx.extract.soup import PolygonSoup
from oracle.level_set import Facet, LevelSet
from oracle.polytope import Point

TOLERANCE = 1e-9


def disagreements(soup: PolygonSoup, exact: LevelSet) -> list[str]:
    """What differs between ``soup`` and ``exact``, for a network in general position; empty if nothing does.

    Compared are the number of polygons, the corners of each in order (within 1e-9), the gradients, the box faces of the
    edges, and whether equal keys and equal exact vertices are the same thing.
    """
    found = len(soup.offsets) - 1
    if found != len(exact.facets):
        return [f"{found} polygons extracted, {len(exact.facets)} exist"]
    if not found:
        return []
    problems: list[str] = []
    vertex_of_key: dict[tuple[int, int], Point] = {}
    key_of_vertex: dict[Point, tuple[int, int]] = {}
    positions, keys = soup.corner_positions, soup.corner_keys
    for index, facet in enumerate(_matched(soup, exact)):
        corners = slice(soup.offsets[index], soup.offsets[index + 1])
        order = _rotation(positions[corners], facet)
        if order is None:
            problems.append(f"polygon {index}: corners {positions[corners].tolist()}, not {_floats(facet)}")
            continue
        gradient = np.array([float(a) for a in facet.gradient])
        if not np.allclose(soup.gradients[index], gradient, rtol=TOLERANCE, atol=TOLERANCE):
            problems.append(f"polygon {index}: gradient {soup.gradients[index]}, not {gradient}")
        for corner, (first, second) in enumerate(zip(order, order[1:] + order[:1], strict=True), corners.start):
            key = (int(keys[corner, 0]), int(keys[corner, 1]))
            if vertex_of_key.setdefault(key, first) != first:
                problems.append(f"polygon {index}: its key at {positions[corner]} is that of another vertex")
            if key_of_vertex.setdefault(first, key) != key:
                problems.append(f"polygon {index}: the vertex at {positions[corner]} has more than one key")
            expected = exact.box_faces((first, second)) or [-1]
            if soup.box_faces[corner] not in expected:
                problems.append(f"polygon {index}: an edge on box face {soup.box_faces[corner]}, not {expected}")
    return problems


def _matched(soup: PolygonSoup, exact: LevelSet) -> list[Facet]:
    """The exact facet with the nearest centroid and gradient for every polygon of the soup."""
    sizes = np.diff(soup.offsets)
    centroids = np.add.reduceat(soup.corner_positions, soup.offsets[:-1]) / sizes[:, None]
    tree = KDTree(np.array([[float(x) for x in (*facet.centroid, *facet.gradient)] for facet in exact.facets]))
    nearest = tree.query(np.concatenate([centroids, soup.gradients], axis=1))[1]
    return [exact.facets[index] for index in nearest]


def _rotation(corners: NDArray[np.float64], facet: Facet) -> tuple[Point, ...] | None:
    """The facet's vertices in the order of ``corners``, or None if they are not the same cycle."""
    vertices = _floats(facet)
    if vertices.shape != corners.shape:
        return None
    for shift in range(len(vertices)):
        if np.abs(np.roll(vertices, -shift, axis=0) - corners).max() <= TOLERANCE:
            return facet.vertices[shift:] + facet.vertices[:shift]
    return None


def _floats(facet: Facet) -> NDArray[np.float64]:
    return np.array([[float(x) for x in vertex] for vertex in facet.vertices])
