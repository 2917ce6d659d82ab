"""Which side of a level set is outside, and the canonical network that grows towards it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import UsageError
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.ir.network import AffineRow
from mn_onnx.ir.passes import Canonical

Floats = NDArray[np.float64]

Sign = Literal["auto", "positive-outside", "positive-inside"]
SIGNS: tuple[str, ...] = get_args(Sign)


def resolve_sign(canonical: Canonical, wanted: str | None) -> str:
    """``positive-outside`` or ``positive-inside``, as ``wanted``, or by the values at the corners of the box.

    The corners of a box around an object are outside. Where they do not agree, values grow outwards by convention.
    Raises `UsageError` for another word.
    """
    if wanted is not None and wanted not in SIGNS:
        raise UsageError(f"sign {wanted!r} is none of {', '.join(SIGNS)}")
    if wanted is not None and wanted != "auto":
        return wanted
    corners = np.array(list(itertools.product(*zip(canonical.lower, canonical.upper, strict=True))))
    below = evaluate(canonical.network, corners, true_functions=True) < 0
    return "positive-inside" if below.all() else "positive-outside"


def oriented(canonical: Canonical, sign: str) -> Canonical:
    """``canonical`` with a network that grows outwards: negated where the output is positive inside."""
    if sign == "positive-outside":
        return canonical
    row = canonical.network.output
    output = AffineRow(row.columns, -row.weights, -row.bias)
    return replace(canonical, network=replace(canonical.network, output=output), sign=-canonical.sign)
