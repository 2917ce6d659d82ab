"""What failed in an extraction, and what is legal but worth knowing, in sentences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.checks.parity import Parity
from mn_onnx.checks.residual import Residuals
from mn_onnx.extract.invariants import Invariants
from mn_onnx.extract.pipeline import Extraction
from mn_onnx.model import Model

GRID_POINTS = 30_000
"""About so many values of the output are looked at for the one that is nearest to a level without a surface."""


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
    elif found.degeneracy.found:
        notes.append(
            f"degenerate network ({'; '.join(found.degeneracy.found)}), and no perturbation of it has a better mesh: "
            "what lies closer together than rounding may be missing"
        )
        if found.statistics.broken_cuts:
            problems.append(f"{found.statistics.broken_cuts} cells could not be cut, and what is in them is missing")
    if not invariants.polygons:
        notes.append(empty_level_set(model, has_flat_regions=bool(found.flat_regions)))
    return problems, notes


def empty_level_set(model: Model, *, has_flat_regions: bool = False) -> str:
    """Why there is nothing to extract, with the certified range of f and the value nearest to the level."""
    values = model.evaluate(_grid(model))
    nearest = values[np.abs(values - model.level).argmin()]
    if values.min() < model.level < values.max() and not has_flat_regions:
        found = f"no surface was found, but the output takes values on both sides of the level {model.level:g}"
        if model.exact:
            return f"{found}: either they differ from it by rounding only, or this is a fault of mn-onnx"
        return (
            f"{found}: its surrogates are too coarse (off by up to {model.surrogate_eps:.3g}); try more "
            "--knots-per-period, or --bounds closer to the surface"
        )
    if has_flat_regions or nearest == model.level:
        return (
            f"there is no surface: the output reaches the level {model.level:g} but does not pass through it; try a "
            "level a little higher or lower"
        )
    reason = model.canonical.empty_reason
    if not reason:
        low, high = model.output_range
        reason = f"f, which is zero on it, is certified within {low:.6g} to {high:.6g} in the box"
    return (
        f"the level set is empty: {reason}; of the output's values on a grid, {nearest:.6g} is nearest to the level "
        f"{model.level:g}; try another level or larger bounds"
    )


def _grid(model: Model) -> NDArray[np.float64]:
    """About `GRID_POINTS` points in the box, float64 [n, dimension]."""
    per_axis = round(GRID_POINTS ** (1 / model.dimension))
    axes = [np.linspace(low, high, per_axis) for low, high in model.bounds]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, model.dimension)
