"""What a model is, told before any extraction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mn_onnx.errors import Problem
from mn_onnx.ir.network import Network
from mn_onnx.model import Model
from mn_onnx.report import model_entries
from mn_onnx.summaries import box_text


def describe(model: Model) -> dict[str, Any]:
    """What ``model`` is, ready for JSON.

    The entries of `mn_onnx.report.model_entries`, and ``verdict`` (``exact`` or ``surrogate``), ``dimension``,
    ``ir_version``, ``opsets``, ``producer``, ``empty`` (certainly no level set in the box), and per stage
    (``imported``, ``canonical``) the ``units``, the units of each layer, the ``knots`` and ``weights``.
    """
    low, high = model.output_range
    proto = model.read.model
    return {
        "verdict": "exact" if model.exact else "surrogate",
        **model_entries(model),
        "dimension": model.dimension,
        "ir_version": proto.ir_version,
        "opsets": {entry.domain or "ai.onnx": entry.version for entry in proto.opset_import},
        "producer": f"{proto.producer_name} {proto.producer_version}".strip(),
        "empty": low > 0 or high < 0,
        "imported": count(model.imported.network),
        "canonical": count(model.network),
    }


def count(network: Network) -> dict[str, Any]:
    """Sizes of a network: units, units per layer, knots in all tables, weights of all rows."""
    tables = [unit.table for unit in network.units if unit.table is not None]
    rows = [network.output, *(unit.row for unit in network.units)]
    return {
        "units": len(network.units),
        "layers": np.bincount(network.unit_level).tolist(),
        "knots": sum(table.knots.size for table in tables) if len(tables) == len(network.units) else None,
        "weights": sum(row.columns.size for row in rows),
    }


def describe_refusal(name: str, problems: Sequence[Problem]) -> dict[str, Any]:
    """Why a model is refused, ready for JSON."""
    return {
        "verdict": "refused",
        "model": name,
        "problems": [
            {
                "node": problem.node,
                "op": problem.op,
                "opset": problem.opset,
                "reason": problem.reason,
                "remedy": problem.remedy,
            }
            for problem in problems
        ],
    }


def as_text(description: dict[str, Any]) -> str:
    """The result of `describe` for people."""
    low, high = description["output_range"]
    eps = description["surrogate_eps"]
    fidelity = (
        "exact" if description["exact"] else f"with piecewise-linear surrogates, |f_true - f| <= {eps:.3g} in the box"
    )
    lines = [
        f"{description['model']}  sha256 {description['model_sha256'][:16]}...",
        f"  written by   {description['producer'] or 'unknown'}; "
        + ", ".join(f"{domain} {version}" for domain, version in description["opsets"].items()),
        f"  field        {description['output']!r} over {description['dimension']} coordinates",
        f"  extraction   {fidelity}",
    ]
    if description["heads"]:
        lines.append(f"  heads        {', '.join(description['heads'])}, inverted at the level: f is the value before")
    if description["forecast_polygons"] is not None:
        knots = description["knots_per_period"]
        fineness = "" if knots is None else f" at {knots:.3g} knots per period"
        pieces = {1: "roots", 2: "segments", 3: "polygons"}[description["dimension"]]
        lines.append(f"  expected     about {description['forecast_polygons']:,} {pieces}{fineness}")
    for stage in ("imported", "canonical"):
        sizes = description[stage]
        layers = " + ".join(str(units) for units in sizes["layers"]) or "none"
        knots = "" if sizes["knots"] is None else f", {sizes['knots']:,} knots"
        lines.append(f"  {stage:<12} {sizes['units']:,} units ({layers}){knots}, {sizes['weights']:,} weights")
    lines.append(f"  box          {box_text(description)}")
    verdict = "; certainly no level set in the box" if description["empty"] else ""
    lines.append(f"  level        {description['level']:g}: f is certified within {low:.6g} .. {high:.6g}{verdict}")
    return "\n".join(lines)
