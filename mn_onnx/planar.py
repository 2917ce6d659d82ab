"""The library's main functions for networks over two coordinates and over one: curves and roots."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mn_onnx.checks.findings import empty_level_set
from mn_onnx.checks.residual import position_rounding
from mn_onnx.checks.runtime import Runtime
from mn_onnx.errors import CheckFailed, UsageError
from mn_onnx.extract.pipeline import Extraction
from mn_onnx.extract.planar.curve import Curve, Roots
from mn_onnx.extract.planar.prism import extract_curve, extract_roots
from mn_onnx.ir.evaluate import evaluate, float64_error_bound, gradient
from mn_onnx.model import LoadOptions, Model
from mn_onnx.progress import ProgressCallback
from mn_onnx.reader import ModelSource
from mn_onnx.report import model_entries, parity_entries
from mn_onnx.run import Phases, Run, loaded, prepare

Floats = NDArray[np.float64]

RESIDUAL_SLACK = 4
"""|f| at a vertex may be this many times the rounding bound of f there: the vertex itself is rounded, too."""


@dataclass(frozen=True, eq=False)
class PlanarLevelSet:
    """A level set below three dimensions and the report on it.

    ``level_set``: a `Curve` for a network over two coordinates, `Roots` for one. ``report``: the entries of
    `mn_onnx.report` that make sense here, with ``polylines``, ``segments``, ``closed``, ``length`` and ``area`` of a
    curve or the number of ``roots``, and ``max_abs_f`` at its points.
    """

    level_set: Curve | Roots
    report: dict[str, Any]

    @property
    def points(self) -> Floats:
        """The vertices or roots, float64 [n, dimension]."""
        found = self.level_set
        return found.positions[:, None] if isinstance(found, Roots) else found.vertices


def extract_planar(
    source: Model | ModelSource,
    *,
    threads: int | None = None,
    check: bool = True,
    max_memory: int | None = None,
    progress: ProgressCallback | None = None,
    **options: Unpack[LoadOptions],
) -> PlanarLevelSet:
    """Extract the level set {x in box | f(x) = level} of a network over one or two coordinates.

    Arguments as in `mn_onnx.extract`. An empty level set has no points and a note in the report.

    Raises `UsageError` for a network over another number of coordinates, and as `mn_onnx.extract` does.
    """
    phases = Phases(progress)
    model = loaded(source, options, phases)
    if model.dimension not in (1, 2):
        raise UsageError(f"the field is over {model.dimension} coordinates: use extract, which makes a mesh")
    run = prepare(model, phases, threads=threads, check=check, max_memory=max_memory)
    level_set, extraction = _extracted(model, run)
    phases.seconds.update(extraction.seconds)
    found = PlanarLevelSet(level_set, {})
    problems, notes = level_set.problems(), []
    residuals: dict[str, float | None] = {"max_abs_f": None, "ort_mean_abs_f": None}
    if not len(found.points):
        notes.append(empty_level_set(model, has_flat_regions=bool(extraction.flat_regions)))
    else:
        with phases.phase("check"):
            residuals, failed = _residuals(model, found.points, run.runtime, extraction.position_error)
            problems += failed
    report = {
        **model_entries(model),
        **_measures(level_set),
        **residuals,
        **parity_entries(run.parity),
        **_traversal_entries(extraction),
        "seconds": dict(phases.seconds),
        "problems": problems,
        "notes": notes,
    }
    found.report.update(report)
    if check and problems:
        raise CheckFailed(problems)
    return found


def _extracted(model: Model, run: Run) -> tuple[Curve | Roots, Extraction]:
    """The level set, and the extraction in three dimensions that it was found by."""
    if model.dimension == 2:
        curve = extract_curve(model.network, model.lower, model.upper, **run.traversal())
        return curve.curve, curve.prism
    roots = extract_roots(model.network, model.lower, model.upper, **run.traversal())
    return roots.roots, roots.slab


def _measures(level_set: Curve | Roots) -> dict[str, Any]:
    if isinstance(level_set, Roots):
        return {"roots": int(level_set.positions.size)}
    return {
        "polylines": level_set.n_polylines,
        "segments": level_set.n_segments,
        "closed": bool(level_set.closed.all()),
        "length": float(level_set.length),
        "area": level_set.area,
    }


def _residuals(
    model: Model, points: Floats, runtime: Runtime | None, position_error: float | None
) -> tuple[dict[str, float | None], list[str]]:
    residual = np.abs(evaluate(model.network, points))
    # Points lie on knots, where the slope is that of one side: so the steepest of all.
    steepest = np.linalg.norm(gradient(model.network, points), axis=1).max()
    moved = steepest * (position_error or position_rounding(model)) * np.sqrt(model.dimension)
    allowed = RESIDUAL_SLACK * float64_error_bound(model.network, points) + moved
    worst = int(np.argmax(residual - allowed))
    problems = []
    if residual[worst] > allowed[worst]:
        problems.append(
            f"|f| is {residual[worst]:.3g} at a point of the level set; rounding explains {allowed[worst]:.3g}"
        )
    by_runtime = None
    if runtime is not None:
        asked = points[: runtime.most_points]
        by_runtime = float(np.abs(runtime.evaluate(asked) - model.level).mean())
    return {"max_abs_f": float(residual.max()), "ort_mean_abs_f": by_runtime}, problems


def _traversal_entries(extraction: Extraction) -> dict[str, Any]:
    return {
        "nodes": extraction.statistics.nodes,
        "threads": extraction.statistics.threads,
        "degeneracy": asdict(extraction.degeneracy),
    }
