"""Other programs that run ONNX, as judges of our own reading: onnxruntime, or onnx's reference evaluator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from mn_onnx.errors import CheckFailed, ModelRefused, Problem
from mn_onnx.layout import Feeds, Layout
from mn_onnx.reader import ReadModel

Floats = NDArray[np.float64]
Run = Callable[[Feeds], Mapping[str, NDArray[Any]]]

LARGEST_BATCH = 1 << 16
"""The largest static batch that is run."""
BATCH = 1 << 12
"""Points per call where the model takes any number: few enough for the caches of a core, whatever the width."""
CALLS = 1 << 14
"""Most calls for one measurement: a model that takes one point at a time is asked at this many points."""

_REMEDY = "--no-check extracts without a comparison"

ORT_REFUSALS = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
)
"""What onnxruntime raises on models and inputs that it cannot run."""


class Runtime:
    """Evaluates the model as it was stored, at points. ``name`` says by which program; ``note`` why not onnxruntime.

    ``threads``: for onnxruntime, its own choice by default. ``most_points``: how many it evaluates in reasonable time.
    Raises `CheckFailed` where no program can load the model, `ModelRefused` where it takes too many points at once.
    """

    def __init__(self, read: ReadModel, layout: Layout, *, threads: int | None = None) -> None:
        if layout.batch is not None and layout.batch > LARGEST_BATCH:
            reason = f"takes {layout.batch:,} points at once, too many to run it for comparison"
            remedy = f"export it with a free batch axis or a batch of at most {LARGEST_BATCH:,} points; {_REMEDY}"
            raise ModelRefused([Problem("", "", 0, reason, remedy)])
        self._layout = layout
        self.most_points = CALLS * (layout.batch or BATCH)
        self.note = ""
        try:
            self._run = _onnxruntime(read.original, layout.output.name, threads)
            self.name = f"onnxruntime {onnxruntime.__version__}"
        except ORT_REFUSALS as error:
            self.note = f"onnxruntime cannot run this model ({str(error).splitlines()[0]})"
            self._run = _reference(read.original, layout.output.name, self.note)
            self.name = f"onnx.reference {onnx.__version__}"

    def evaluate(self, points: Floats, *, batch: int = BATCH) -> Floats:
        """Values float64 [n] at ``points`` [n, dim], ``batch`` points a call (or as many as a static model takes).

        Raises `CheckFailed` if the program stops with an error.
        """
        values = np.empty(len(points))
        for start in range(0, len(points), batch):
            part = points[start : start + batch]
            values[start : start + len(part)] = self._layout.evaluate(self._run, part)
        return values


def open_session(model: onnx.ModelProto, *, threads: int | None = None) -> onnxruntime.InferenceSession:
    """A session of onnxruntime for the model; raises `ORT_REFUSALS`. ``threads``: by default as it sees fit."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or 0
    options.log_severity_level = 4  # what goes wrong arrives as an exception
    return onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])


def _onnxruntime(model: onnx.ModelProto, output: str, threads: int | None) -> Run:
    try:
        session = open_session(model, threads=threads)
    except ORT_REFUSALS:
        # The file format's version says what a file may contain; an older one that allows these operator sets will do.
        oldest = onnx.helper.find_min_ir_version_for(list(model.opset_import), ignore_unknown=True)
        if model.ir_version <= oldest:
            raise
        older = onnx.ModelProto()
        older.CopyFrom(model)
        older.ir_version = oldest
        session = open_session(older, threads=threads)

    def run(feeds: Feeds) -> Mapping[str, NDArray[Any]]:
        try:
            return {output: session.run([output], feeds)[0]}
        except ORT_REFUSALS as error:
            raise CheckFailed([f"onnxruntime stopped while evaluating the model: {error}"]) from error

    return run


def _reference(model: onnx.ModelProto, output: str, note: str) -> Run:
    # The evaluator raises whatever its numpy code raises; these are the kinds it documents or was seen to raise.
    refusals = (RuntimeError, NotImplementedError, TypeError, ValueError, KeyError, IndexError, AttributeError)
    try:
        evaluator = ReferenceEvaluator(model)
    except refusals as error:
        raise CheckFailed([f"{note}, nor can onnx.reference ({error}); {_REMEDY}"]) from error

    def run(feeds: Feeds) -> Mapping[str, NDArray[Any]]:
        try:
            values = list(evaluator.run([output], feeds))
        except refusals as error:
            raise CheckFailed([f"{note}, and onnx.reference stopped ({error}); {_REMEDY}"]) from error
        return {output: values[0]}

    return run
