"""New names for the variables of a row."""

from __future__ import annotations

import numpy as np

from mn_onnx.ir.levels import affine_row
from mn_onnx.ir.network import AffineRow, Integers


def rename(row: AffineRow, position: Integers) -> AffineRow:
    """``row`` over new variables: ``position`` (int64 [old variables]) maps them; several may become one."""
    columns = position[row.columns]
    if (np.diff(columns) > 0).all():
        return AffineRow(columns, row.weights, row.bias)
    merged, inverse = np.unique(columns, return_inverse=True)
    weights = np.zeros(merged.size)
    np.add.at(weights, inverse, row.weights)
    return affine_row(merged, weights, row.bias)
