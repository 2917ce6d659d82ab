"""The library's main function: from a model to a checked mesh."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import CheckFailed, UsageError
from mn_onnx.extract.invariants import Invariants, check_invariants
from mn_onnx.extract.pipeline import Extraction, extract_surface
from mn_onnx.extract.schedule import Progress
from mn_onnx.extract.surface import Surface
from mn_onnx.memory import MemoryLimit
from mn_onnx.model import LoadOptions, Model, load
from mn_onnx.parity import Parity, check_parity
from mn_onnx.progress import ProgressCallback, ProgressEvent
from mn_onnx.reader import ModelSource
from mn_onnx.report import build_report
from mn_onnx.residual import Residuals, measure_residuals, true_residuals
from mn_onnx.runtime import Runtime
from mn_onnx.surrogates import NOT_CERTIFIED, certified, polished
from mn_onnx.warmup import warm_up

DIMENSION = 3
"""Coordinates of a point on a mesh."""


@dataclass
class Phases:
    """Tells the listener which phase begins, and keeps the time of each."""

    listener: ProgressCallback | None
    seconds: dict[str, float] = field(default_factory=dict)

    def announce(self, event: ProgressEvent) -> None:
        if self.listener is not None:
            self.listener(event)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        self.announce(ProgressEvent(name))
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


def extract(
    source: Model | ModelSource,
    *,
    threads: int | None = None,
    check: bool = True,
    max_memory: int | None = None,
    polish: bool = False,
    progress: ProgressCallback | None = None,
    **options: Unpack[LoadOptions],
) -> Surface:
    """Extract the level set {x in box | f(x) = level} as a welded mesh of convex polygons.

    ``source``: a `Model` from `load`, or what `load` takes (path, bytes or message), with ``options`` as there.
    ``threads``: all cores by default; the mesh does not depend on it. ``check``: compare the imported network with
    onnxruntime before, and measure the mesh after. ``max_memory``: most bytes that the process may occupy, by default
    what it has and 80 % of what is available. ``polish``: move the vertices of a smooth network's mesh onto the level
    set of the true network; the topology stays. ``progress``: called with a `ProgressEvent` a few times a second.

    Returns a `Surface`: ``vertices`` float64 [v, 3], polygons oriented towards growing f, and ``report``, whose keys
    `mn_onnx.report` lists. ``errors`` are proved bounds on |f_true - f| on each polygon (before polishing), zero for
    exact networks. An empty level set is a surface without polygons.

    Raises `UsageError` and `ModelRefused` as `load`; `CheckFailed` with every failed check (``error.surface`` is the
    mesh, if there is one already); `MemoryLimitReached` if the mesh would not fit in ``max_memory``.
    """
    phases = Phases(progress)
    if isinstance(source, Model):
        if options:
            raise UsageError(f"the model is loaded already: give {', '.join(options)} to load")
        model = source
    else:
        phases.announce(ProgressEvent("import"))
        model = load(source, **options)
    if model.dimension != DIMENSION:
        raise UsageError(
            f"the field has {model.dimension} coordinates, but a mesh needs {DIMENSION}; "
            "curves and roots are extracted by mn_onnx.extract_planar"
        )
    if threads is not None and threads < 1:
        raise UsageError(f"threads must be at least 1, not {threads}")
    limit = MemoryLimit.of(max_memory)
    phases.seconds.update(model.seconds)

    runtime = parity = residuals = None
    if check:
        with phases.phase("check"):
            runtime = Runtime(model.read, model.imported.layout)
            parity = check_parity(model, runtime)
            if parity.problems():
                raise CheckFailed(parity.problems())
    with phases.phase("compile"):
        warm_up(DIMENSION)
    found = extract_surface(
        model.network,
        model.lower,
        model.upper,
        threads=threads,
        progress=traversal_listener(phases, limit),
        on_phase=lambda name: phases.announce(ProgressEvent(name)),
    )
    phases.seconds.update(found.seconds)
    surface = found.surface
    with phases.phase("check"):
        invariants = check_invariants(surface, bounds=model.bounds)
        if check and surface.n_polygons and invariants.area > 0:
            residuals = measure_residuals(model, surface, runtime)
    certificate, polish_entries = dict[str, Any](NOT_CERTIFIED), None
    if not model.exact and surface.n_polygons:
        with phases.phase("certify"):
            surface, certificate = certified(surface, model.canonical, threads=threads)
    if polish and not model.exact and surface.n_polygons:
        with phases.phase("polish"):
            surface, polish_entries = polished(surface, model.canonical, threads=threads)
            polish_entries |= true_residuals(model, surface)
    problems, notes = findings(model, found, invariants, parity, residuals)
    report = build_report(
        model,
        found,
        invariants=invariants,
        parity=parity,
        residuals=residuals,
        certificate=certificate,
        polish=polish_entries,
        seconds=phases.seconds,
        problems=problems,
        notes=notes,
    )
    surface = surface.with_report(**report)
    if check and problems:
        raise CheckFailed(problems, surface)
    return surface


def traversal_listener(phases: Phases, limit: MemoryLimit) -> Callable[[Progress], None]:
    """What to give a traversal as its listener: watches the memory and passes the progress on."""

    def listen(event: Progress) -> None:
        limit.check(event.polygons, event.corners)
        phases.announce(ProgressEvent("traverse", event.nodes, event.polygons))

    return listen


def findings(
    model: Model,
    found: Extraction,
    invariants: Invariants,
    parity: Parity | None,
    residuals: Residuals | None,
) -> tuple[list[str], list[str]]:
    """What failed, and what is legal but worth knowing, a sentence each."""
    problems, notes = invariants.problems(), invariants.notes()
    if residuals is not None and residuals.worst_ratio > 1:
        problems.append(
            f"|f| is up to {residuals.max_abs_f:.3g} on the mesh, "
            f"{residuals.worst_ratio:.3g} times what rounding explains"
        )
    if parity is not None and parity.note:
        notes.append(f"{parity.note}; compared with {parity.runtime} instead")
    if found.flat_regions:
        notes.append(
            f"f is at the level throughout parts of the box (about {found.flat_regions.share:.2g} of it): "
            "of the level set there, the mesh shows the border with f < level only"
        )
    if found.degeneracy.perturbation is not None:
        notes.append(
            f"degenerate network ({'; '.join(found.degeneracy.found)}): the mesh is the limit of that of a network "
            f"perturbed by {found.degeneracy.perturbation:g}; its vertices were taken back by up to "
            f"{found.degeneracy.displacement:.2g}"
        )
    if not invariants.polygons:
        notes.append(empty_level_set(model))
    return problems, notes


def empty_level_set(model: Model) -> str:
    """Why there is nothing to extract, with the certified range of f and the value nearest to the level."""
    reason = model.canonical.empty_reason
    if not reason:
        low, high = model.output_range
        reason = f"f, which is zero on it, is certified within {low:.6g} to {high:.6g} in the box"
    values = model.evaluate(_grid(model))
    nearest = values[np.abs(values - model.level).argmin()]
    return (
        f"the level set is empty: {reason}; of the output's values on a grid, {nearest:.6g} is nearest to the level "
        f"{model.level:g}; try another level or larger bounds"
    )


def _grid(model: Model) -> NDArray[np.float64]:
    """About 30,000 points in the box, float64 [n, dimension]."""
    per_axis = round(30_000 ** (1 / model.dimension))
    axes = [np.linspace(low, high, per_axis) for low, high in model.bounds]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, model.dimension)
