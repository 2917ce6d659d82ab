"""The report of an extraction, ready for JSON.

Its keys:

- ``model``, ``model_sha256``, ``output``, ``level``, ``bounds``, ``threads``, ``versions``: what was extracted by what;
- ``sign``: positive-outside or positive-inside; ``bounds_from``: option, metadata or default;
- ``heads``: the monotone functions at the output's end that were inverted at the level, the outermost first: f, f_true
  and their errors are the values before them, and only ``true_max_abs_f``, ``true_mean_abs_f``, ``ort_mean_abs_f`` and
  the comparison with onnxruntime are about the output itself;
- ``exact``, and ``surrogate_eps``: a proved bound on |f_true - f| in the box, zero for exact networks;
- ``knots_per_period`` and ``forecast_polygons`` of the surrogates, null for exact networks;
- ``surface_eps``, ``surface_eps_median``: proved bounds of |f_true| on the polygons; ``displacement``,
  ``displacement_median``: that over the slope, how far the true level set may be to first order, where the slope is at
  least a tenth of the median one (``shallow_polygons`` are the others); ``vague_polygons``: those with a displacement
  bound above a twentieth of the box, which says nothing; ``gradient_angle_median``, in degrees: between the gradients
  of the surrogates and of the true network on the faces, ``turned_share``: the part of the area where it exceeds 90, so
  that the topology need not be that of the network; null for exact networks;
- ``polish``: what moving the vertices onto the true level set did (`mn_onnx.extract.smooth.polish.Polish`), and
  ``true_max_abs_f``, ``true_mean_abs_f`` on its faces, before it with ``_before``, and ``surface_eps`` to
  ``vague_polygons`` as above, of the polished mesh; null where not asked for. All invariants are those of the polished
  mesh, the values of `Residuals` those of the mesh before;
- ``output_range``: the certified range of the piecewise-linear f, which is zero on the level set, in the box;
- ``polygons``, ``vertices``, ``edges``, ``euler``, ``components``, ``closed`` (every edge inside the box joins two
  polygons), ``boundary_edges`` (on the box), ``unmatched_edges``, and the other values of `Invariants`;
- ``max_abs_f``, ``mean_abs_f``, ``ort_mean_abs_f`` and the other values of `Residuals`, null where there was no check
  or nothing to measure;
- ``parity_max_abs_err``, ``parity_allowed_err``, ``parity_points``, ``parity_runtime``, ``parity_note``: the comparison
  of the imported network with onnxruntime, null without checks;
- ``nodes``; and the counts of `mn_onnx.extract.schedule.TraversalStatistics` under ``traversal``, with ``profile``
  and ``layers``, which `mn_onnx.profile` describes;
- ``degeneracy``, ``flat_regions``: `Degeneracy` and `FlatRegions`, what was not in general position and what was done;
- ``seconds``: import, lower, compile (loading or compiling the kernels), traverse, weld, certify, polish, check, write;
  flat (looking for regions of zeros), and perturb where planes coincide;
- ``problems``: what failed, ``notes``: what is legal but worth knowing.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from mn_onnx import __version__
from mn_onnx.checks.parity import Parity
from mn_onnx.checks.residual import Residuals
from mn_onnx.extract.invariants import Invariants
from mn_onnx.extract.pipeline import Extraction
from mn_onnx.model import Model
from mn_onnx.profile import layer_entries, profile_entries


def model_entries(model: Model) -> dict[str, Any]:
    """The part of a report that tells of the model alone."""
    return {
        "model": model.read.name,
        "model_sha256": model.read.sha256,
        "output": model.imported.network.output_name,
        "level": model.level,
        "bounds": model.bounds.tolist(),
        "heads": list(model.canonical.heads),
        "exact": model.exact,
        "sign": model.sign,
        "bounds_from": model.bounds_from,
        "surrogate_eps": model.surrogate_eps,
        "knots_per_period": model.fineness.knots_per_period if model.fineness else None,
        "forecast_polygons": round(model.fineness.forecast.pieces) if model.fineness else None,
        "output_range": list(model.output_range),
        "versions": versions(),
    }


def check_entries(parity: Parity | None, residuals: Residuals | None) -> dict[str, Any]:
    """The part of a report that tells of comparisons; null where there were none."""
    measured = asdict(residuals) if residuals else dict.fromkeys(Residuals.__dataclass_fields__)
    measured["residual_points"] = measured.pop("points")
    measured["residual_ratio"] = measured.pop("worst_ratio")
    return parity_entries(parity) | measured


def parity_entries(parity: Parity | None) -> dict[str, Any]:
    """The part of a report that tells of the comparison with onnxruntime; null where there was none."""
    return {
        "parity_runtime": parity.runtime if parity else None,
        "parity_note": parity.note if parity else None,
        "parity_points": parity.points if parity else None,
        "parity_max_abs_err": parity.max_abs_err if parity else None,
        "parity_allowed_err": parity.allowed_err if parity else None,
    }


def build_report(
    model: Model,
    found: Extraction,
    *,
    invariants: Invariants,
    parity: Parity | None,
    residuals: Residuals | None,
    certificate: Mapping[str, Any],
    polish: Mapping[str, Any] | None,
    seconds: Mapping[str, float],
    problems: Sequence[str],
    notes: Sequence[str],
) -> dict[str, Any]:
    """All entries; see the description of this module."""
    statistics = found.statistics
    return {
        **model_entries(model),
        **invariants.as_dict(),
        **check_entries(parity, residuals),
        **certificate,
        "polish": None if polish is None else dict(polish),
        "nodes": statistics.nodes,
        "threads": statistics.threads,
        "traversal": {
            **asdict(statistics),
            "profile": profile_entries(statistics.profile),
            "layers": layer_entries(statistics.layers),
        },
        "degeneracy": asdict(found.degeneracy),
        "flat_regions": asdict(found.flat_regions),
        "seconds": dict(seconds),
        "problems": list(problems),
        "notes": list(notes),
    }


def versions() -> dict[str, str]:
    """Versions of this program, of Python and of the packages that decide the result."""
    packages = {name: version(name) for name in ("numpy", "numba", "onnx", "onnxruntime", "trimesh")}
    return {"mn-onnx": __version__, "python": platform.python_version(), "platform": platform.platform(), **packages}
