"""The types of the versioned operator table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from mn_onnx.lowering.node import Node

if TYPE_CHECKING:
    from mn_onnx.lowering.context import Context

Fidelity = Literal["exact", "surrogate"]
Lower = Callable[["Context", Node], Any]
"""Gives the value of the first output, or a sequence with one value per output."""


@dataclass(frozen=True)
class Lowering:
    """How an operator is lowered from version ``since`` of its domain on.

    ``fidelity``: whether the result is piecewise linear wherever its inputs are, or needs a surrogate.
    ``on_constants``: the lowering itself handles inputs that are all constant; otherwise onnx's reference evaluator
    folds those.
    """

    since: int
    lower: Lower
    fidelity: Fidelity = "exact"
    on_constants: bool = False


@dataclass(frozen=True)
class Refusal:
    """Why an operator on data that depend on the points (if ``never_fold``, on any) is refused, and what to do."""

    reason: str
    remedy: str
    never_fold: bool = False


Table = Mapping[str, Sequence[Lowering]]


def same(lower: Lower, since: int = 1, fidelity: Fidelity = "exact", *, on_constants: bool = False) -> list[Lowering]:
    """The entry of an operator whose definition has not changed, for what is lowered, since ``since``."""
    return [Lowering(since, lower, fidelity, on_constants)]
