"""The measurements themselves, made in a fresh process each."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from mn_onnx.bench.cubes import Cubes, marching_cubes
from mn_onnx.bench.options import BenchOptions
from mn_onnx.bench.quality import reference_points, soft_precision, soft_recall
from mn_onnx.bench.result import CUBES, EXACT, Measurement
from mn_onnx.bench.sampler import fastest, open_runtime
from mn_onnx.errors import MnOnnxError
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.pipeline import Extraction, extract_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.memory import MemoryLimit, peak_memory, resident_memory
from mn_onnx.model import Model, load
from mn_onnx.warmup import warm_up

Seconds = dict[str, float]
Result = TypeVar("Result")


@dataclass(frozen=True)
class Job:
    """One measurement to make, of the model in the file ``path``; ``resolution`` is None for exact extraction."""

    path: str
    resolution: int | None
    threads: int
    options: BenchOptions

    @property
    def title(self) -> str:
        """What is measured, for people."""
        return EXACT if self.resolution is None else f"{CUBES} {self.resolution}^3"


@dataclass(frozen=True)
class Failure:
    """Why a measurement could not be made."""

    reason: str


def measure(job: Job) -> Measurement | Failure:
    """Carry out ``job`` in this process, which should be a fresh one, since its memory is measured."""
    try:
        return _measure_exact(job) if job.resolution is None else _measure_cubes(job, job.resolution)
    except MnOnnxError as error:
        return Failure(f"{job.title}: {error}")


def _measure_exact(job: Job) -> Measurement:
    model = load(job.path, **job.options.load)
    limit = MemoryLimit.of(job.options.max_memory)
    started = time.perf_counter()
    warm_up().triangles()
    warm = time.perf_counter() - started

    def run() -> tuple[Extraction, Seconds]:
        extraction = extract_surface(
            model.network,
            model.lower,
            model.upper,
            threads=job.threads,
            progress=lambda event: limit.check(event.polygons, event.corners),
        )
        started = time.perf_counter()
        extraction.surface.triangles()
        return extraction, {**extraction.seconds, "tessellate": time.perf_counter() - started}

    timed = _repeat(run, job.options.repeat)
    surface = timed.result.surface
    invariants = check_invariants(surface, bounds=model.bounds)
    note = "; ".join(invariants.problems())
    found = _measured(job, model, surface, timed, dict(model.seconds), warm, note)
    return replace(found, components=len(invariants.components), euler=invariants.euler)


def _measure_cubes(job: Job, resolution: int) -> Measurement:
    model = load(job.path, **job.options.load)
    started = time.perf_counter()
    runtime, note = open_runtime(model, job.options.load, job.threads)
    opened = time.perf_counter()
    sampler = fastest(runtime, note, model.lower, model.upper)
    marching_cubes(sampler.evaluate, model.level, model.lower, model.upper, 8)
    warm = time.perf_counter() - opened

    def run() -> tuple[Cubes, Seconds]:
        cubes = marching_cubes(sampler.evaluate, model.level, model.lower, model.upper, resolution)
        return cubes, cubes.seconds

    timed = _repeat(run, job.options.repeat)
    triangles = timed.result.triangles
    surface = Surface.from_polygons(timed.result.vertices, np.arange(len(triangles) + 1) * 3, triangles.reshape(-1))
    return _measured(job, model, surface, timed, {"session": opened - started}, warm, note)


@dataclass(frozen=True, eq=False)
class _Timed(Generic[Result]):
    """Runs of one method: the last ``result``, and the rest as in `Measurement`."""

    result: Result
    seconds: Seconds
    total: float
    peak_bytes: int | None
    idle_bytes: int


def _repeat(run: Callable[[], tuple[Result, Seconds]], times: int) -> _Timed[Result]:
    """Run ``times`` times; the seconds of each phase, and the sums, are medians."""
    idle = resident_memory()
    taken = []
    result, seconds = run()
    taken.append(seconds)
    for _ in range(times - 1):
        del result  # before the next run, which would else be measured with both in memory
        result, seconds = run()
        taken.append(seconds)
    phases = {phase: statistics.median(entry[phase] for entry in taken) for phase in seconds}
    return _Timed(result, phases, statistics.median(sum(entry.values()) for entry in taken), peak_memory(), idle)


def _measured(
    job: Job,
    model: Model,
    surface: Surface,
    timed: _Timed[Result],
    preparation: Seconds,
    warm_up: float,
    note: str,
) -> Measurement:
    """The measurement of a method that gave ``surface``, with the quality of that."""
    reference = job.options.reference
    return Measurement(
        method=EXACT if job.resolution is None else CUBES,
        resolution=job.resolution,
        preparation=preparation,
        warm_up=warm_up,
        seconds=timed.seconds,
        total=timed.total,
        peak_bytes=timed.peak_bytes,
        idle_bytes=timed.idle_bytes,
        polygons=surface.n_polygons,
        triangles=surface.n_corners - 2 * surface.n_polygons,
        vertices=surface.n_vertices,
        corners=surface.n_corners,
        components=None,
        euler=None,
        soft_precision=soft_precision(model, surface, job.options.samples),
        soft_recall=None if reference is None else soft_recall(reference_points(reference), surface),
        note=note,
    )
