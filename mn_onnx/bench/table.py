"""A benchmark's result for people."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from mn_onnx.bench.result import BenchResult, Measurement, ModelResult
from mn_onnx.memory import format_size


def print_result(result: BenchResult, console: Console) -> None:
    """One table per model, and below it how the methods compare and what failed."""
    for model in result.models:
        console.print(_table(result, model))
        lines = ["ratio: seconds of exact extraction to those of the row; memory: the peak of the whole process"]
        lines += [_phases(entry) for entry in model.measurements]
        lines += [f"{entry.title}: {entry.note}" for entry in model.measurements if entry.note]
        for line in (*lines, *model.failures):
            console.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)


def _table(result: BenchResult, model: ModelResult) -> Table:
    with_recall = any(entry.soft_recall is not None for entry in model.measurements)
    title = f"{model.model}, {result.threads} threads, median of {result.repeat}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    heads = ["method", "seconds", "ratio", "memory", "triangles", "mean |f|"]
    for head in [*heads, "recall"] if with_recall else heads:
        table.add_column(head, justify="left" if head == "method" else "right", no_wrap=True)
    for entry in model.measurements:
        ratio = model.ratios.get(entry.resolution) if entry.resolution is not None else None
        cells = [
            entry.title,
            f"{entry.total:.3f}",
            "" if ratio is None else f"{ratio:.2f}",
            "unknown" if entry.peak_bytes is None else format_size(entry.peak_bytes),
            f"{entry.triangles:,}",
            _number(entry.soft_precision),
        ]
        table.add_row(*cells, *([_number(entry.soft_recall)] if with_recall else []))
    return table


def _phases(entry: Measurement) -> str:
    """The seconds of each phase, and of what came before and is not in the total."""
    phases = ", ".join(f"{phase} {seconds:.3f}" for phase, seconds in entry.seconds.items())
    before = {**entry.preparation, "warm-up": entry.warm_up}
    return f"{entry.title}: {phases}; before: {', '.join(f'{name} {spent:.2f}' for name, spent in before.items())}"


def _number(value: float | None) -> str:
    return "no surface" if value is None else f"{value:.2g}"


def markdown(result: BenchResult) -> str:
    """The table of the README: counts and times of exact extraction beside marching cubes."""
    grids = sorted({resolution for model in result.models for resolution in model.ratios})
    heads = ["network", "polygons", "vertices", "components", "Euler", "mean abs(f)", "peak memory", "exact, s"]
    heads += [f"{grid}^3, s" for grid in grids] + [f"{grid}^3, mean abs(f)" for grid in grids]
    machine = result.machine
    lines = [
        f"mn-onnx {machine['versions']['mn-onnx']}, {result.threads} threads of {machine['cores']} cores "
        f"({machine['architecture']}), median of {result.repeat} runs, kernels warm, box as the model has it. *exact*: "
        "traverse, weld, tessellate. *N^3*: marching cubes of N^3 points, evaluated by onnxruntime on as many threads. "
        f"*mean abs(f)*: over {result.samples:,} random points of the mesh, in float64.",
        "",
        f"| {' | '.join(heads)} |",
        "|" + "---|" * len(heads),
    ]
    lines += [_markdown_row(model, grids) for model in result.models]
    return "\n".join(lines)


def _markdown_row(model: ModelResult, grids: list[int]) -> str:
    exact, sampled = model.exact, {entry.resolution: entry for entry in model.sampled}
    if exact is None or sampled.keys() != set(grids):
        return f"| `{model.model.removesuffix('.onnx')}` | {'; '.join(model.failures)} |"
    cells = [
        f"`{model.model.removesuffix('.onnx')}`",
        f"{exact.polygons:,}",
        f"{exact.vertices:,}",
        f"{exact.components}",
        f"{exact.euler}",
        _number(exact.soft_precision),
        "unknown" if exact.peak_bytes is None else format_size(exact.peak_bytes),
        f"{exact.total:.2f}",
        *(f"{sampled[grid].total:.2f}" for grid in grids),
        *(_number(sampled[grid].soft_precision) for grid in grids),
    ]
    return f"| {' | '.join(cells)} |"
