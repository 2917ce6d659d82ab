"""Where the time of an extraction went, as text (``--profile``) and as entries of the report.

The table of phases has the seconds of each. The table of cells says at which size of network the traversal spends its
time. A cell's *system* is the network restricted to it, or to an ancestor since which nothing was folded away; cells
are grouped by the number of units of that system, in powers of two. Per group: *cells* visited, *share* of all
processor cycles spent on visits, and *cycles* per cell, as the processor's time-stamp counter tells them. Many cells in
the upper groups: the bounds prune too little, or folding comes too late. Most of the time in the lowest groups: cutting
polytopes and emitting polygons is what counts. The last table groups the same cells by the number of layers in which
the system has units left: much time where all layers have some means bounds that are loose in depth.

The counts: *pruned* cells that the bound of the output excludes when visited, cells *trimmed* to the slab that the
surface can reach, or *shaved* of slices that the surface was proved to miss, *folds* of systems, *leaves* whose
polygons were emitted, *deepest* level of the tree, *subtrees* given to threads.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def profile_entries(profile: NDArray[np.int64] | None) -> list[dict[str, Any]]:
    """The groups that have cells, ready for JSON: ``units`` [least, most], ``cells``, ``share``, ``cycles_per_cell``.

    ``profile``: int64 [2, n], cells and cycles by the bit length of the number of units; None gives an empty list.
    """
    return [
        {"units": [1 << (length - 1), (1 << length) - 1] if length else [0, 0], **spent}
        for length, spent in _groups(profile)
    ]


def layer_entries(layers: NDArray[np.int64] | None) -> list[dict[str, Any]]:
    """As `profile_entries`, with the number of ``layers``, of which the last group holds that or more.

    ``layers``: int64 [2, n], cells and cycles by the number of layers that have units left.
    """
    return [{"layers": number, **spent} for number, spent in _groups(layers)]


def _groups(profile: NDArray[np.int64] | None) -> list[tuple[int, dict[str, Any]]]:
    if profile is None:
        return []
    total = max(int(profile[1].sum()), 1)
    return [
        (
            group,
            {"cells": int(cells), "share": int(cycles) / total, "cycles_per_cell": int(cycles) / int(cells)},
        )
        for group, (cells, cycles) in enumerate(profile.T)
        if cells
    ]


def profile_text(report: Mapping[str, Any]) -> str:
    """The profile in a report, as tables of plain text."""
    seconds, traversal = report["seconds"], report["traversal"]
    total = sum(seconds.values()) or 1.0
    lines = ["phase          seconds   share"]
    lines += [f"{name:<12} {spent:>9.3f} {spent / total:>7.1%}" for name, spent in seconds.items()]
    lines += ["", "units of system        cells   share   cycles per cell"]
    for group in traversal["profile"]:
        low, high = group["units"]
        lines.append(_line(f"{low}" if low == high else f"{low} to {high}", group))
    lines += ["", "layers of system       cells   share   cycles per cell"]
    lines += [_line(str(group["layers"]), group) for group in traversal["layers"]]
    nodes = max(traversal["nodes"], 1)
    polygons = report["polygons"]
    lines += [
        "",
        f"cells {traversal['nodes']:,}: pruned {traversal['pruned'] / nodes:.1%}, "
        f"trimmed {traversal['trimmed'] / nodes:.1%}, shaved {traversal['shaved'] / nodes:.1%}, "
        f"leaves {traversal['leaves'] / nodes:.1%}, folds {traversal['folds']:,}",
        f"polygons {polygons:,}, cells per polygon {traversal['nodes'] / max(polygons, 1):.2f}, "
        f"deepest {traversal['deepest']}, subtrees {traversal['subtrees']}, threads {traversal['threads']}",
    ]
    return "\n".join(lines)


def _line(label: str, group: Mapping[str, Any]) -> str:
    return f"{label:<15} {group['cells']:>12,} {group['share']:>7.1%} {group['cycles_per_cell']:>17,.0f}"
