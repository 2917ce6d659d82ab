"""What every extraction begins with: a loaded model, the comparison with onnxruntime, compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass

from mn_onnx.checks.parity import Parity, check_parity
from mn_onnx.checks.runtime import Runtime
from mn_onnx.errors import CheckFailed, UsageError
from mn_onnx.extract.clock import PhaseClock
from mn_onnx.extract.pipeline import RunOptions
from mn_onnx.extract.schedule import Progress
from mn_onnx.memory import MemoryLimit
from mn_onnx.model import LoadOptions, Model, load
from mn_onnx.progress import ProgressCallback, ProgressEvent
from mn_onnx.reader import ModelSource
from mn_onnx.warmup import warm_up

MOST_THREADS = 1024
"""Every thread has memory of its own."""


class Phases(PhaseClock):
    """The clock of a run whose ``listener``, if there is one, is told of each phase and of progress within it."""

    def __init__(self, listener: ProgressCallback | None) -> None:
        super().__init__(lambda phase: self.announce(ProgressEvent(phase)))
        self.listener = listener

    def announce(self, event: ProgressEvent) -> None:
        if self.listener is not None:
            self.listener(event)


@dataclass(frozen=True, eq=False)
class Run:
    """An extraction that is ready for its traversal.

    ``runtime``, ``parity``: the program that the model was compared with and the outcome, None without checks.
    """

    phases: Phases
    threads: int | None
    limit: MemoryLimit
    runtime: Runtime | None
    parity: Parity | None

    def traversal(self) -> RunOptions:
        """How the traversal runs: it watches the memory and passes its progress on."""

        def listen(event: Progress) -> None:
            self.limit.check(event.polygons, event.corners)
            self.phases.announce(ProgressEvent("traverse", event.nodes, event.polygons))

        return {"threads": self.threads, "progress": listen, "on_phase": self.phases.on_phase}


def loaded(source: Model | ModelSource, options: LoadOptions, phases: Phases) -> Model:
    """``source`` itself if it is a model, else what `load` makes of it. Raises as `load`."""
    if isinstance(source, Model):
        if options:
            raise UsageError(f"the model is loaded already: give {', '.join(options)} to load")
        return source
    phases.announce(ProgressEvent("import"))
    return load(source, **options)


def check_threads(threads: int | None) -> None:
    """Raise `UsageError` for a number of threads that makes no sense."""
    if threads is not None and not 1 <= threads <= MOST_THREADS:
        raise UsageError(f"threads must be at least 1 and at most {MOST_THREADS}, not {threads}")


def prepare(model: Model, phases: Phases, *, threads: int | None, check: bool, max_memory: int | None) -> Run:
    """Compare ``model`` with onnxruntime if ``check`` is asked for, and compile or load the kernels.

    Raises `UsageError` for senseless ``threads`` or ``max_memory``, `CheckFailed` if the comparison fails.
    """
    check_threads(threads)
    limit = MemoryLimit.of(max_memory)
    phases.seconds.update(model.seconds)
    runtime = parity = None
    if check:
        with phases.phase("check"):
            runtime = Runtime(model.read, model.imported.layout)
            parity = check_parity(model, runtime)
            if parity.problems():
                raise CheckFailed(parity.problems())
    with phases.phase("compile"):
        warm_up(threads)
    return Run(phases, threads, limit, runtime, parity)
