"""Time against error, as a picture."""

from __future__ import annotations

import os
from itertools import cycle
from pathlib import Path

from mn_onnx.bench.result import BenchResult
from mn_onnx.errors import UsageError
from mn_onnx.extract.files.whole import written_whole

SMALLEST_ERROR = 1e-18
"""Errors of zero are drawn here, for want of a place on a logarithmic axis."""
_COLOURS = ("#0b6e99", "#c0504d", "#4f7f3a", "#7a5195", "#b8860b", "#444444")


def check_picture(path: str | os.PathLike[str]) -> None:
    """Raise `UsageError` unless `plot` can write the format of the ending of ``path``."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    ending = Path(path).suffix.lower().removeprefix(".")
    if ending not in known:
        raise UsageError(f"--plot {path}: pictures are written to .{', .'.join(sorted(known))}")


def plot(result: BenchResult, path: str | os.PathLike[str]) -> None:
    """Write a picture in the format of the ending of ``path``: seconds against mean |f|, both logarithmic.

    Each model has a line of its grids and a star, its exact extraction. Raises OSError if the file cannot be written,
    ValueError for an ending that `check_picture` refuses.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for model, colour in zip(result.models, cycle(_COLOURS), strict=False):
        grids = [entry for entry in model.sampled if entry.soft_precision is not None]
        times = [entry.total for entry in grids]
        errors = [max(entry.soft_precision or 0.0, SMALLEST_ERROR) for entry in grids]
        axes.plot(times, errors, "o-", color=colour, label=f"{model.model}: marching cubes")
        for entry, x, y in zip(grids, times, errors, strict=True):
            axes.annotate(f"{entry.resolution}³", (x, y), textcoords="offset points", xytext=(6, 4), color=colour)
        exact = model.exact
        if exact is not None and exact.soft_precision is not None:
            error = max(exact.soft_precision, SMALLEST_ERROR)
            axes.plot([exact.total], [error], "*", markersize=14, color=colour, label=f"{model.model}: exact")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="mean |f - level| on the surface")
    axes.set_title(f"{result.threads} threads, median of {result.repeat}")
    axes.grid(visible=True, which="major", alpha=0.3)
    if result.models:
        axes.legend(fontsize=8)
    target = Path(path)
    with written_whole(target) as stream:
        figure.savefig(stream, dpi=120, format=target.suffix.lower().removeprefix("."))
