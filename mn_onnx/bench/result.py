"""What a benchmark found, ready for JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

EXACT, CUBES = "exact", "marching cubes"


@dataclass(frozen=True)
class Measurement:
    """One method on one model, measured in a process of its own.

    ``resolution``: points per axis of the grid, None for exact extraction. ``preparation``: seconds of what is done
    once per model (import and lower; session), ``warm_up`` those of compiling or loading kernels, or of finding the
    best batch. ``seconds``: of each phase, medians of the repetitions, and ``total``, the median of their sums.
    ``peak_bytes``: the most memory that the process occupied while measured, ``idle_bytes`` before that; None where the
    system does not tell. ``corners``: those of all polygons. ``components`` and ``euler``: of exact meshes.
    ``soft_precision``: mean |f - level| over random points of the mesh, uniform by area, with the true activations in
    float64. ``soft_recall``: mean distance of random points of the reference from the mesh. ``note``: what to know.
    """

    method: str
    resolution: int | None
    preparation: dict[str, float]
    warm_up: float
    seconds: dict[str, float]
    total: float
    peak_bytes: int | None
    idle_bytes: int
    polygons: int
    triangles: int
    vertices: int
    corners: int
    components: int | None
    euler: int | None
    soft_precision: float | None
    soft_recall: float | None
    note: str = ""

    @property
    def title(self) -> str:
        """The method, with the grid it used."""
        return self.method if self.resolution is None else f"{self.method} {self.resolution}^3"


@dataclass(frozen=True)
class ModelResult:
    """All measurements of one model; ``failures`` says what could not be measured, a sentence each."""

    model: str
    sha256: str
    measurements: list[Measurement]
    failures: list[str] = field(default_factory=list)

    @property
    def exact(self) -> Measurement | None:
        """The exact extraction, if it succeeded."""
        return next((entry for entry in self.measurements if entry.resolution is None), None)

    @property
    def sampled(self) -> list[Measurement]:
        """Marching cubes, by grid."""
        return [entry for entry in self.measurements if entry.resolution is not None]

    @property
    def ratios(self) -> dict[int, float]:
        """By grid: the time of exact extraction, divided by that of marching cubes."""
        exact = self.exact
        return (
            {}
            if exact is None
            else {entry.resolution: exact.total / entry.total for entry in self.sampled if entry.resolution}
        )


@dataclass(frozen=True)
class BenchResult:
    """A whole run: ``machine`` tells where, ``threads``, ``repeat`` and ``samples`` how."""

    machine: dict[str, Any]
    threads: int
    repeat: int
    samples: int
    reference: str | None
    models: list[ModelResult]

    def as_dict(self) -> dict[str, Any]:
        """All values, ready for JSON, with the ratios of each model."""
        values = asdict(self)
        for entry, model in zip(values["models"], self.models, strict=True):
            entry["ratios"] = {str(resolution): ratio for resolution, ratio in model.ratios.items()}
        return values
