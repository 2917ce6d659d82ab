"""What a mesh writer gets: plain arrays of polygons, and values for each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices
from mn_onnx.extract.errors import MnOnnxError

CHUNK = 1 << 17
"""Rows that are turned into bytes or text at a time."""


class MeshFileError(MnOnnxError):
    """A mesh file cannot be written or read as asked."""


@dataclass(frozen=True, eq=False)
class PolygonMesh:
    """``vertices`` [v, 3], ``offsets`` [p + 1], ``corners`` [c], unit ``normals`` [p, 3]; ``columns`` [p] by name."""

    vertices: NDArray[np.float64]
    offsets: NDArray[np.int64]
    corners: Indices
    normals: NDArray[np.float64]
    columns: Mapping[str, NDArray[Any]]

    @property
    def n_polygons(self) -> int:
        return self.offsets.size - 1

    @property
    def triangles(self) -> Indices:
        """Corners by triangle, [p, 3], of a mesh of triangles."""
        return self.corners.reshape(-1, 3)


def chunks(n_rows: int) -> Iterator[slice]:
    """Slices that cover ``n_rows``, each of at most `CHUNK` rows."""
    for begin in range(0, n_rows, CHUNK):
        yield slice(begin, min(begin + CHUNK, n_rows))
