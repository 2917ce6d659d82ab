"""Lowering of ONNX operators to symbolic tensors: one module per family, joined here to one versioned table."""

from __future__ import annotations

from collections.abc import Sequence

from mn_onnx.lowering import (
    activation,
    arithmetic,
    contrib,
    control,
    einsum,
    indexing,
    linear,
    quantised,
    reduction,
    shape,
)
from mn_onnx.lowering.refusals import REFUSALS
from mn_onnx.lowering.table import Lowering, Table

_FAMILIES: tuple[tuple[str, Table], ...] = (
    ("", linear.LOWERINGS),
    ("", einsum.LOWERINGS),
    ("", activation.LOWERINGS),
    ("", arithmetic.LOWERINGS),
    ("", reduction.LOWERINGS),
    ("", shape.LOWERINGS),
    ("", indexing.LOWERINGS),
    ("", control.LOWERINGS),
    ("", quantised.LOWERINGS),
    ("com.microsoft", contrib.MICROSOFT),
    ("ai.onnx.ml", contrib.MACHINE_LEARNING),
)

LOWERINGS: dict[tuple[str, str], Sequence[Lowering]] = {
    (domain, operator): entries for domain, family in _FAMILIES for operator, entries in family.items()
}
"""Every operator that is lowered: ``(domain, operator)`` to its entries, of which the newest that applies is taken."""

__all__ = ["LOWERINGS", "REFUSALS"]
