"""The measurements themselves, made in a fresh process each."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mn_onnx.bench.cubes import Cubes, marching_cubes
from mn_onnx.bench.quality import reference_points, soft_precision, soft_recall
from mn_onnx.bench.result import CUBES, EXACT, Measurement
from mn_onnx.bench.sampler import fastest, open_runtime
from mn_onnx.errors import MnOnnxError
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.pipeline import Extraction, extract_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.memory import MemoryLimit, peak_memory, resident_memory
from mn_onnx.model import LoadOptions, Model, load
from mn_onnx.warmup import warm_up

Seconds = dict[str, float]
Result = TypeVar("Result")


@dataclass(frozen=True)
class Job:
    """One measurement to make; ``resolution`` is None for exact extraction. The rest as in `BenchOptions`."""

    path: str
    load: LoadOptions
    resolution: int | None
    threads: int
    repeat: int
    samples: int
    reference: str | None
    max_memory: int | None

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
    model = load(job.path, **job.load)
    limit = MemoryLimit.of(job.max_memory)
    started = time.perf_counter()
    warm_up().triangles()
    warm = time.perf_counter() - started
    idle = resident_memory()

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

    extraction, seconds, total = _repeat(run, job.repeat)
    peak = peak_memory()
    surface = extraction.surface
    invariants = check_invariants(surface, bounds=model.bounds)
    return Measurement(
        method=EXACT,
        resolution=None,
        preparation=dict(model.seconds),
        warm_up=warm,
        seconds=seconds,
        total=total,
        peak_bytes=peak,
        idle_bytes=idle,
        polygons=surface.n_polygons,
        triangles=surface.n_corners - 2 * surface.n_polygons,
        vertices=surface.n_vertices,
        corners=surface.n_corners,
        components=len(invariants.components),
        euler=invariants.euler,
        **_quality(job, model, surface),
        note="; ".join(invariants.problems()),
    )


def _measure_cubes(job: Job, resolution: int) -> Measurement:
    model = load(job.path, **job.load)
    started = time.perf_counter()
    runtime, note = open_runtime(model, job.load, job.threads)
    opened = time.perf_counter()
    sampler = fastest(runtime, note, model.lower, model.upper)
    marching_cubes(sampler.evaluate, model.level, model.lower, model.upper, 8)
    warm = time.perf_counter() - opened
    idle = resident_memory()

    def run() -> tuple[Cubes, Seconds]:
        cubes = marching_cubes(sampler.evaluate, model.level, model.lower, model.upper, resolution)
        return cubes, cubes.seconds

    cubes, seconds, total = _repeat(run, job.repeat)
    peak = peak_memory()
    corners = cubes.triangles.reshape(-1)
    surface = Surface.from_polygons(cubes.vertices, np.arange(len(cubes.triangles) + 1) * 3, corners)
    return Measurement(
        method=CUBES,
        resolution=resolution,
        preparation={"session": opened - started},
        warm_up=warm,
        seconds=seconds,
        total=total,
        peak_bytes=peak,
        idle_bytes=idle,
        polygons=surface.n_polygons,
        triangles=surface.n_polygons,
        vertices=surface.n_vertices,
        corners=corners.size,
        components=None,
        euler=None,
        **_quality(job, model, surface),
        note=note,
    )


def _repeat(run: Callable[[], tuple[Result, Seconds]], times: int) -> tuple[Result, Seconds, float]:
    """The last result, the median seconds of each phase, and the median of the sums."""
    taken = []
    result, seconds = run()
    taken.append(seconds)
    for _ in range(times - 1):
        del result  # before the next run, which would else be measured with both in memory
        result, seconds = run()
        taken.append(seconds)
    phases = {phase: statistics.median(entry[phase] for entry in taken) for phase in seconds}
    return result, phases, statistics.median(sum(entry.values()) for entry in taken)


def _quality(job: Job, model: Model, surface: Surface) -> dict[str, float | None]:
    recall = None if job.reference is None else soft_recall(reference_points(job.reference), surface)
    return {"soft_precision": soft_precision(model, surface, job.samples), "soft_recall": recall}
