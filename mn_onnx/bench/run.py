"""A benchmark from start to end: models by methods, one fresh process for each."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil

from mn_onnx.bench.extras import RECALL, SAMPLING, require
from mn_onnx.bench.options import BenchOptions
from mn_onnx.bench.quality import reference_points
from mn_onnx.bench.result import BenchResult, Measurement, ModelResult
from mn_onnx.bench.worker import Failure, Job, measure
from mn_onnx.errors import MnOnnxError, UsageError
from mn_onnx.extract.blocks import resolve_threads
from mn_onnx.extract.files import MeshFileError
from mn_onnx.model import LoadOptions, load
from mn_onnx.report import versions


def run_bench(
    models: Sequence[str | os.PathLike[str]],
    options: BenchOptions | None = None,
    *,
    on_start: Callable[[str], None] | None = None,
) -> BenchResult:
    """Measure exact extraction and marching cubes on each of ``models`` (paths).

    ``on_start`` is called with a line before each measurement. What fails for one method is told in the ``failures`` of
    its model. Raises `UsageError` before anything is measured if an option, a model or the reference is
    unusable, or if packages of the extra ``bench`` are missing.
    """
    options = options or BenchOptions()
    options.check()
    require(SAMPLING | RECALL if options.reference else SAMPLING)
    if options.reference:
        _check_reference(options.reference)
    machine = _machine()
    paths = [Path(model) for model in models]
    hashes = _check_models(paths, options.load)
    threads = resolve_threads(options.threads)
    options = replace(options, threads=threads)
    results = []
    for path, sha256 in zip(paths, hashes, strict=True):
        outcomes = []
        for resolution in (None, *sorted(set(options.grids))):
            job = Job(str(path), resolution, threads, options)
            if on_start is not None:
                on_start(f"{path.name}: {job.title}")
            outcomes.append(in_fresh_process(job))
        measurements = [outcome for outcome in outcomes if isinstance(outcome, Measurement)]
        failures = [outcome.reason for outcome in outcomes if isinstance(outcome, Failure)]
        results.append(ModelResult(path.name, sha256, measurements, failures))
    return BenchResult(machine, threads, options.repeat, options.samples, options.reference, results)


def _check_reference(path: str) -> None:
    try:
        reference_points(path)
    except (MeshFileError, OSError, ValueError) as error:
        raise UsageError(f"--reference {path}: {error}") from error


def _check_models(paths: Sequence[Path], options: LoadOptions) -> list[str]:
    """The hashes of models that can be measured; raises `UsageError` with the reasons of all that cannot."""
    hashes, problems = [], []
    for path in paths:
        try:
            model = load(path, **options)
        except MnOnnxError as error:
            problems.append(f"{path}: {error}")
            continue
        if model.dimension != 3:
            problems.append(
                f"{path}: marching cubes needs a field over 3 coordinates, this one is over {model.dimension}"
            )
        hashes.append(model.read.sha256)
    if problems:
        raise UsageError("\n".join(problems))
    return hashes


def in_fresh_process(job: Job) -> Measurement | Failure:
    """Carry out ``job`` in a new process, which is ended when this one is interrupted."""
    context = get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_measurement, args=(sender, job), daemon=True)
    process.start()
    sender.close()  # the child holds the only other end: when it dies, there is nothing more to receive
    try:
        outcome: Measurement | Failure = receiver.recv()
    except EOFError:
        process.join()
        cause = "it was killed, perhaps for lack of memory" if (process.exitcode or 0) < 0 else "see the message above"
        return Failure(f"{job.title}: the process ended with code {process.exitcode}: {cause}")
    finally:
        process.terminate()  # on an interrupt
        process.join()
    return outcome


def _send_measurement(sender: Connection, job: Job) -> None:
    sender.send(measure(job))


def _machine() -> dict[str, Any]:
    return {
        "cores": os.cpu_count(),
        "architecture": platform.machine(),
        "memory_bytes": int(psutil.virtual_memory().total),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {**versions(), "scikit-image": version("scikit-image")},
    }
