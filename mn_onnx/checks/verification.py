"""Checks of a mesh file against a model: any mesh, from this program or another."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from mn_onnx.checks.parity import check_parity
from mn_onnx.checks.residual import measure_residuals
from mn_onnx.checks.runtime import Runtime
from mn_onnx.errors import UsageError
from mn_onnx.extract.files import MeshFileError, read_mesh
from mn_onnx.extract.invariants import check_invariants, mark_box_edges
from mn_onnx.extract.surface import Surface
from mn_onnx.extraction import DIMENSION
from mn_onnx.ir.evaluate import gradient
from mn_onnx.model import Model
from mn_onnx.report import check_entries, model_entries
from mn_onnx.run import check_threads

BOX_ROUNDING = 1e-5
"""How far a vertex may lie outside the box, relative to it: meshes are often kept in float32."""
TURNED_SHARE = 0.01
"""Polygons of at most this share of the area may face the wrong side: their normals may be rounding."""
FLOAT32_ROUNDING = float(np.finfo(np.float32).eps) / 2


def verify(
    mesh: str | os.PathLike[str], model: Model, *, tolerance: float | None = None, threads: int | None = None
) -> dict[str, Any]:
    """Measure the invariants of a mesh file, and |f - level| on it.

    ``tolerance``: the largest |f| to accept; by default what the rounding of coordinates to float32 explains, which
    only a mesh of the exact level set meets. ``threads``: all cores by default.

    Returns the entries of `mn_onnx.report` that apply to a file, with ``problems`` (empty if the mesh is right) and
    ``notes``. Raises `UsageError` if the file cannot be read as a mesh.
    """
    if tolerance is not None and not 0 <= tolerance < np.inf:
        raise UsageError(f"the tolerance must be a number of at least 0, not {tolerance}")
    check_threads(threads)
    if model.dimension != DIMENSION:
        raise UsageError(f"the field has {model.dimension} coordinates, but a mesh has {DIMENSION}")
    try:
        surface = read_mesh(mesh, threads=threads)
    except (MeshFileError, OSError) as error:
        raise UsageError(f"cannot read the mesh {os.fspath(mesh)}: {error}") from error
    surface = mark_box_edges(surface, model.bounds)
    invariants = check_invariants(surface, bounds=model.bounds)
    problems, notes = invariants.problems(), invariants.notes()
    runtime = Runtime(model.read, model.imported.layout)
    parity = check_parity(model, runtime)
    problems += parity.problems()
    residuals = None
    if not surface.n_polygons:
        problems.append("the mesh has no polygons")
    elif not invariants.area > 0:
        problems.append("the mesh has no area")
    else:
        rounding = FLOAT32_ROUNDING * float(np.abs(surface.vertices).max())
        residuals = measure_residuals(model, surface, runtime, position_error=rounding, most_vertices=None)
        if tolerance is None and residuals.worst_ratio > 1:
            problems.append(
                f"|f - level| is up to {residuals.max_abs_f:.3g} on the mesh, {residuals.worst_ratio:.3g} times "
                "what the rounding of its coordinates explains: it is not the exact level set"
            )
        elif tolerance is not None and residuals.max_abs_f > tolerance:
            problems.append(f"|f - level| is up to {residuals.max_abs_f:.3g} on the mesh, more than {tolerance:g}")
        problems += _place_problems(model, surface)
        notes.append("whether the mesh is the whole level set is not checked, only that it lies on it")
    return {
        "mesh": os.fspath(mesh),
        **model_entries(model),
        **invariants.as_dict(),
        **check_entries(parity, residuals),
        "problems": problems,
        "notes": notes,
    }


def _place_problems(model: Model, surface: Surface) -> list[str]:
    """Vertices outside the box, and polygons that face the side where f is smaller."""
    problems = []
    size = float(max(np.abs(model.bounds).max(), (model.upper - model.lower).max()))
    beyond = np.maximum(model.lower - surface.vertices, surface.vertices - model.upper).max(axis=1)
    outside = int(np.count_nonzero(beyond > BOX_ROUNDING * size))
    if outside:
        problems.append(f"{outside} of {surface.n_vertices} vertices lie outside the box")
    gradients = gradient(model.network, surface.centres(np.arange(surface.n_polygons)), true_functions=True)
    turned = np.einsum("ij,ij->i", gradients, surface.measures.area_vectors) < 0
    areas = surface.measures.areas
    share = float(areas[turned].sum() / areas.sum())
    if share > TURNED_SHARE:
        problems.append(
            f"polygons of {share:.2g} of the area face the side where the field is smaller (--sign {model.sign})"
        )
    return problems
