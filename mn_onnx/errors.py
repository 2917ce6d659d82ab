"""The exceptions that users meet, and the problems that a refusal lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mn_onnx.extract.errors import MnOnnxError

if TYPE_CHECKING:
    from mn_onnx.extract.surface import Surface


__all__ = ["CheckFailed", "MemoryLimitReached", "MnOnnxError", "ModelRefused", "Problem", "UsageError"]


class UsageError(MnOnnxError):
    """An argument, option or path is wrong."""


class MemoryLimitReached(MnOnnxError):
    """The extraction needs more memory than it was allowed; nothing was written."""


class CheckFailed(MnOnnxError):
    """A result contradicts its checks: parity with onnxruntime, or the invariants of the mesh.

    ``problems``: every failed check, a sentence each. ``surface``: the mesh that failed, with its report, if any.
    """

    def __init__(self, problems: Sequence[str], surface: Surface | None = None) -> None:
        self.problems = list(problems)
        self.surface = surface
        super().__init__("\n".join(f"check failed: {problem}" for problem in self.problems))


@dataclass(frozen=True)
class Problem:
    """One reason why a model is refused.

    ``node``: name of the ONNX node, tensor or input concerned (empty: the whole model); ``op``: its operator, with the
    domain unless it is the standard one (empty if ``node`` is not a node); ``opset``: the version of that domain that
    the model imports (0 if unknown); ``reason``: what was found and what is supported; ``remedy``: what users can do.
    """

    node: str
    op: str
    opset: int
    reason: str
    remedy: str = ""

    def __str__(self) -> str:
        detail = f" ({self.op}, opset {self.opset})" if self.op and self.opset else f" ({self.op})" if self.op else ""
        subject = (self.node or "model") + detail
        return f"{subject}: {self.reason}" + (f"\n  Fix: {self.remedy}" if self.remedy else "")


class ModelRefused(MnOnnxError):
    """The model cannot be imported; ``problems`` lists every reason, in graph order."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))
