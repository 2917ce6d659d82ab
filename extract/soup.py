"""What the traversal emits: polygons with combinatorial vertex keys, not yet welded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PolygonSoup:
    """``p`` convex polygons with ``c`` corners in all, in canonical order (it does not depend on threads or splits).

    ``offsets``: int64 [p + 1]; polygon ``i`` owns corners ``offsets[i]:offsets[i + 1]``, counter-clockwise seen from
    the side where ``f`` is larger.
    ``positions``: float64 [c, 3], in the input frame of the network.
    ``keys``: uint64 [c, 2], the combinatorial identity of the vertex; equal keys are the same vertex.
    ``box_faces``: int8 [c]; the box face (2 * axis + side, side 1 is the upper) on which the edge from this corner to
    the polygon's next corner lies, -1 for an edge inside the box.
    ``gradients``: float64 [p, 3], the gradient of ``f`` on the polygon.
    ``errors``: float64 [p], a proved bound on ``|f_true - f|`` on the polygon's cell; zero for exact networks.
    """

    offsets: NDArray[np.int64]
    positions: NDArray[np.float64]
    keys: NDArray[np.uint64]
    box_faces: NDArray[np.int8]
    gradients: NDArray[np.float64]
    errors: NDArray[np.float64]
