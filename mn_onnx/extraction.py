"""The library's main function: from a model to a checked mesh."""

from __future__ import annotations

from typing import Any, Unpack

from mn_onnx.certificate import NOT_CERTIFIED, certified, polish_notes, polished, topology_notes
from mn_onnx.checks.findings import findings
from mn_onnx.checks.residual import measure_residuals, true_residuals
from mn_onnx.errors import CheckFailed, UsageError
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.pipeline import extract_surface
from mn_onnx.extract.surface import Surface
from mn_onnx.memory import POLISHED_BYTES
from mn_onnx.model import LoadOptions, Model
from mn_onnx.progress import ProgressCallback
from mn_onnx.reader import ModelSource
from mn_onnx.report import build_report
from mn_onnx.run import Phases, loaded, prepare

DIMENSION = 3
"""Coordinates of a point on a mesh."""


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
    set of the true network, and divide faces that are too coarse for it; the topology stays. ``progress``: called with
    a `ProgressEvent` a few times a second.

    Returns a `Surface`: ``vertices`` float64 [v, 3], polygons oriented towards growing f, and ``report``, whose keys
    `mn_onnx.report` lists. ``errors`` are proved bounds on |f_true - level| on each polygon, zero for exact networks.
    An empty level set is a surface without polygons.

    Raises `UsageError` and `ModelRefused` as `load`; `CheckFailed` with every failed check (``error.surface`` is the
    mesh, if there is one already); `MemoryLimitReached` if the mesh would not fit in ``max_memory``.
    """
    phases = Phases(progress)
    model = loaded(source, options, phases)
    if model.dimension != DIMENSION:
        raise UsageError(
            f"the field has {model.dimension} coordinates, but a mesh needs {DIMENSION}; "
            "curves and roots are extracted by mn_onnx.extract_planar"
        )
    run = prepare(model, phases, threads=threads, check=check, max_memory=max_memory)
    found = extract_surface(model.network, model.lower, model.upper, **run.traversal())
    phases.seconds.update(found.seconds)
    surface, residuals = found.surface, None
    with phases.phase("check"):
        invariants = check_invariants(surface, bounds=model.bounds)
        measurable = surface.n_polygons > 0 and invariants.area > 0
        if check and measurable:
            residuals = measure_residuals(model, surface, run.runtime, position_error=found.position_error)
    certificate, polish_entries, smooth_notes = dict[str, Any](NOT_CERTIFIED), None, list[str]()
    if not model.exact and measurable:
        with phases.phase("certify"):
            surface, certificate = certified(surface, model.canonical, threads=threads)
            smooth_notes = topology_notes(certificate)
    if polish and not model.exact and measurable:
        with phases.phase("polish"):
            before = true_residuals(model, surface)
            room = run.limit.room(POLISHED_BYTES)
            surface, polish_entries = polished(surface, model.canonical, threads=threads, most_polygons=room)
            polish_entries |= {f"{name}_before": value for name, value in before.items()}
            polish_entries |= true_residuals(model, surface)
            smooth_notes += polish_notes(polish_entries)
        with phases.phase("check"):
            invariants = check_invariants(surface, bounds=model.bounds)
    problems, notes = findings(model, found, invariants, run.parity, residuals)
    notes += smooth_notes
    report = build_report(
        model,
        found,
        invariants=invariants,
        parity=run.parity,
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
