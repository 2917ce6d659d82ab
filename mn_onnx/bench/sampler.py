"""The fastest way in which onnxruntime evaluates a model at many points."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from mn_onnx.checks.runtime import Runtime
from mn_onnx.errors import CheckFailed, MnOnnxError
from mn_onnx.model import LoadOptions, Model, load

Floats = NDArray[np.float64]

BATCHES = (1 << 10, 1 << 11, 1 << 12, 1 << 13, 1 << 14, 1 << 16)
"""Points per call to choose from: what a call costs and what the processor's caches hold differ by machine."""
_TRIAL_POINTS = 1 << 17
_COMPARED_POINTS = 64


class Sampler(NamedTuple):
    """A loaded model, the fastest number of points per call, and a note if the model hinders fast evaluation."""

    runtime: Runtime
    batch: int
    note: str

    def evaluate(self, points: Floats) -> Floats:
        """Values float64 [n] at ``points`` [n, 3]."""
        return self.runtime.evaluate(points, batch=self.batch)


def open_runtime(model: Model, options: LoadOptions, threads: int) -> tuple[Runtime, str]:
    """The model in onnxruntime on ``threads`` threads, for any number of points at once if that can be had.

    Models exported for a fixed number of points are tried with a free one; it must give the same values.
    """
    stored = Runtime(model.read, model.imported.layout, threads=threads)
    batch = model.imported.layout.batch
    if batch is None:
        return stored, stored.note
    points = np.random.default_rng(0).uniform(model.lower, model.upper, (_COMPARED_POINTS, model.dimension))
    try:
        freed = load(with_free_batch(model.read.original, batch), **options)
        free = Runtime(freed.read, freed.imported.layout, threads=threads)
        same = freed.imported.layout.batch is None and np.array_equal(
            free.evaluate(points).astype(np.float32), stored.evaluate(points).astype(np.float32)
        )
    except MnOnnxError:
        same = False
    if same:
        return free, f"exported for {batch} points at once, measured with its batch freed"
    return stored, f"exported for {batch} points at once, which slows marching cubes"


def with_free_batch(model: onnx.ModelProto, batch: int) -> onnx.ModelProto:
    """A copy of ``model`` whose inputs and outputs have a free first axis where it was ``batch`` long."""
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    del copy.graph.value_info[:]
    for value in (*copy.graph.input, *copy.graph.output):
        axes = value.type.tensor_type.shape.dim
        if len(axes) > 1 and axes[0].dim_value == batch:
            axes[0].dim_param = "points"
    return copy


def fastest(runtime: Runtime, note: str, lower: Floats, upper: Floats) -> Sampler:
    """The sampler with the best of `BATCHES`.

    Raises `CheckFailed` if the model cannot be evaluated by onnxruntime itself.
    """
    if runtime.note:
        raise CheckFailed([f"{runtime.note}: there is nothing to compare with"])
    points = np.random.default_rng(0).uniform(lower, upper, (min(_TRIAL_POINTS, runtime.most_points), lower.size))
    runtime.evaluate(points, batch=BATCHES[0])  # the first calls allocate
    times = {}
    for batch in BATCHES:
        started = time.perf_counter()
        runtime.evaluate(points, batch=batch)
        times[batch] = time.perf_counter() - started
    return Sampler(runtime, min(times, key=times.__getitem__), note)
