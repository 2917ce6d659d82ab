"""How a benchmark measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from mn_onnx.errors import UsageError
from mn_onnx.model import LoadOptions

GRIDS = (64, 128, 256)
SAMPLES = 1 << 20
REPEAT = 3


@dataclass(frozen=True)
class BenchOptions:
    """How to measure.

    ``grids``: points per axis of marching cubes. ``threads``: for both methods, all cores by default. ``repeat``: runs
    of which the median counts. ``samples``: points of a mesh at which soft precision is measured. ``reference``: mesh
    file of the true shape, for soft recall. ``max_memory``: bytes that exact extraction may take, by default most of
    what is available. ``load``: options of `mn_onnx.load` for all models.
    """

    grids: Sequence[int] = GRIDS
    threads: int | None = None
    repeat: int = REPEAT
    samples: int = SAMPLES
    reference: str | None = None
    max_memory: int | None = None
    load: LoadOptions = field(default_factory=LoadOptions)

    def check(self) -> None:
        """Raise `UsageError` with every number that is too small."""
        counts = [("repeat", self.repeat, 1), ("samples", self.samples, 1)]
        counts += [("a grid", grid, 2) for grid in self.grids]
        if self.threads is not None:
            counts.append(("threads", self.threads, 1))
        problems = [f"{name} must be at least {least}, not {value}" for name, value, least in counts if value < least]
        if problems:
            raise UsageError("; ".join(problems))
