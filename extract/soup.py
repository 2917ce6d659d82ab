"""What the traversal emits: polygons with combinatorial vertex keys, not yet welded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PolygonSoup:
    """``p`` convex polygons with ``c`` corners in all, in canonical order (it does not depend on threads or splits).

    ``offsets``: int64 [p + 1]; polygon ``i`` owns corners ``offsets[i]:offsets[i + 1]``, counter-clockwise seen from
    the side where ``f`` is larger.
    ``corners``: int32 or int64 [c], the point at which each corner lies. Every one of the ``q`` points has a corner,
    and they stand in the order of their first ones. Corners at one point share a vertex; whether those of a vertex
    share one point, or several of equal keys, is left to the traversal, which looks for recent points only.
    ``positions``: float64 [q, 3], in the input frame of the network.
    ``keys``: uint64 [q, 2], the combinatorial identity of the vertex; equal keys are the same vertex.
    ``box_faces``: int8 [c]; the box face (2 * axis + side, side 1 is the upper) on which the edge from this corner to
    the polygon's next corner lies, -1 for an edge inside the box.
    ``gradients``: float64 [p, 3], the gradient of ``f`` on the polygon.
    ``errors``: float64 [p], zeros: bounds on ``|f_true|`` are proved on the finished mesh (`mn_onnx.extract.smooth`).
    """

    offsets: NDArray[np.int64]
    corners: NDArray[np.integer[Any]]
    positions: NDArray[np.float64]
    keys: NDArray[np.uint64]
    box_faces: NDArray[np.int8]
    gradients: NDArray[np.float64]
    errors: NDArray[np.float64]

    @property
    def corner_positions(self) -> NDArray[np.float64]:
        """Where each corner lies, [c, 3]."""
        return np.asarray(self.positions[self.corners])

    @property
    def corner_keys(self) -> NDArray[np.uint64]:
        """The key of each corner, [c, 2]."""
        return np.asarray(self.keys[self.corners])
