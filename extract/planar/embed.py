"""Networks over one or two coordinates as networks over three that do not depend on the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mn_onnx.ir.network import AffineRow, Network

Floats = NDArray[np.float64]

DIMENSIONS = 3


def embed(network: Network, lower: Floats, upper: Floats) -> tuple[Network, Floats, Floats]:
    """The network over (x, .., z), constant along the added coordinates, and its box, which they cross from 0 to 1.

    ``lower``, ``upper``: float64 [input_dim]. Raises ``ValueError`` if the box has another dimension, no interior, or
    the network has more than three inputs.
    """
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    dimension = network.input_dim
    if not 1 <= dimension <= DIMENSIONS:
        raise ValueError(f"the network has {dimension} inputs; level sets are extracted for 1, 2 or 3")
    if low.shape != (dimension,) or high.shape != (dimension,) or not (low < high).all():
        raise ValueError(f"the box {low.tolist()} .. {high.tolist()} has no interior in {dimension} dimensions")
    added = DIMENSIONS - dimension

    def widened(row: AffineRow) -> AffineRow:
        return replace(row, columns=np.where(row.columns < dimension, row.columns, row.columns + added))

    units = tuple(replace(unit, row=widened(unit.row)) for unit in network.units)
    wide = replace(network, input_dim=DIMENSIONS, units=units, output=widened(network.output))
    return wide, np.append(low, np.zeros(added)), np.append(high, np.ones(added))
