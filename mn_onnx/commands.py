"""The commands of the command line, each a function from parsed options to an exit code."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from mn_onnx import options as parse
from mn_onnx.errors import CheckFailed, ModelRefused, UsageError
from mn_onnx.memory import parse_size
from mn_onnx.model import LoadOptions, Model, load
from mn_onnx.progress import ProgressCallback
from mn_onnx.reader import read_model
from mn_onnx.series import count_rows, numbered, row_of


def run_extract(options: argparse.Namespace) -> int:
    """``mn-onnx extract``: write the mesh, and the report if asked; returns 0.

    Raises `CheckFailed`, after the report is written, if a check fails or the level set is empty; no mesh is then left.
    """
    from mn_onnx.extract.blocks import resolve_threads
    from mn_onnx.extract.files import MeshFileError, check_mesh_options, write_mesh
    from mn_onnx.extraction import extract
    from mn_onnx.profile import profile_text
    from mn_onnx.progress import ProgressEvent, TerminalProgress

    if options.all:
        return _extract_rows(options)
    if options.report is not None:
        _check_parent("--report", Path(options.report))
    with TerminalProgress(enabled=not options.quiet) as progress:
        progress(ProgressEvent("import"))
        model = load(options.model, **_load_options(options))
        if model.dimension < 3:
            return _extract_planar(options, model, progress)
        if model.fineness is not None and not options.quiet:
            print(f"mn-onnx: {model.fineness.cost(resolve_threads(options.threads))}", file=sys.stderr)
        try:
            check_mesh_options(options.mesh, float64=options.float64, attributes=options.attributes)
        except MeshFileError as error:
            raise UsageError(str(error)) from error
        try:
            surface = extract(
                model,
                threads=options.threads,
                check=not options.no_check,
                max_memory=_max_memory(options),
                polish=options.polish,
                progress=progress,
            )
        except CheckFailed as error:
            if error.surface is not None:
                _write_report(options.report, error.surface.report)
            raise CheckFailed([*error.problems, "no mesh was written; --no-check writes it all the same"]) from error
        report = dict(surface.report)
        if not surface.n_polygons:
            _write_report(options.report, report)
            raise CheckFailed(report["notes"])
        progress(ProgressEvent("write"))
        started = time.perf_counter()
        try:
            write_mesh(
                surface,
                options.mesh,
                float64=options.float64,
                triangulate=options.triangulate,
                attributes=options.attributes,
            )
        except OSError as error:
            raise UsageError(f"cannot write {options.mesh}: {error.strerror or error}") from error
        report["seconds"] = {**report["seconds"], "write": time.perf_counter() - started}
    _write_report(options.report, report)
    for problem in report["problems"]:
        print(f"mn-onnx: warning: {problem}", file=sys.stderr)
    if options.profile:
        print(profile_text(report), file=sys.stderr)
    if not options.quiet:
        print(_summary(options.mesh, report))
    return 0


def _extract_rows(options: argparse.Namespace) -> int:
    """`run_extract` once for every row of the bound tables, of a model that is read once."""
    bound = parse.bindings(options.bind)
    n_rows = count_rows(bound)
    read = read_model(options.model)
    failures = []
    for row in range(n_rows):
        single = argparse.Namespace(**vars(options))
        single.all, single.row, single.model = False, row, read
        single.mesh = numbered(options.mesh, row, n_rows)
        single.report = None if options.report is None else numbered(options.report, row, n_rows)
        try:
            run_extract(single)
        except CheckFailed as error:
            failures += [f"row {row}: {problem}" for problem in error.problems]
    if failures:
        raise CheckFailed(failures)
    return 0


def _extract_planar(options: argparse.Namespace, model: Model, progress: ProgressCallback) -> int:
    """`run_extract` for a network over one or two coordinates."""
    from mn_onnx.extract.curve_files import check_curve_path, write_curve
    from mn_onnx.extract.files import MeshFileError
    from mn_onnx.planar import extract_planar
    from mn_onnx.progress import ProgressEvent

    try:
        check_curve_path(options.mesh, model.dimension)
    except MeshFileError as error:
        raise UsageError(str(error)) from error
    found = extract_planar(
        model,
        threads=options.threads,
        check=not options.no_check,
        max_memory=_max_memory(options),
        progress=progress,
    )
    _write_report(options.report, found.report)
    if not len(found.points):
        raise CheckFailed(found.report["notes"])
    progress(ProgressEvent("write"))
    try:
        write_curve(found.level_set, options.mesh)
    except OSError as error:
        raise UsageError(f"cannot write {options.mesh}: {error.strerror or error}") from error
    if not options.quiet:
        print(_planar_summary(options.mesh, found.report))
    return 0


def _planar_summary(path: str, report: dict[str, Any]) -> str:
    """A few lines about a curve or roots."""
    if "roots" in report:
        what = f"{report['roots']:,} roots"
    else:
        closure = "closed" if report["closed"] else "open where it leaves the box"
        what = (
            f"{report['polylines']:,} polylines of {report['segments']:,} segments, length {report['length']:.6g}, "
            f"{closure}"
        )
    lines = [f"{path}: {what}; max |f| {report['max_abs_f']:.2g}"]
    if not report["exact"]:
        lines.append(f"  surrogates within {report['surrogate_eps']:.2g} of the true network")
    return "\n".join(lines)


def run_inspect(options: argparse.Namespace) -> int:
    """``mn-onnx inspect``: print what the model is; returns 0, or raises `ModelRefused`."""
    from mn_onnx.inspection import as_text, describe, describe_refusal
    from mn_onnx.ir.text import dump

    try:
        model = load(options.model, **_load_options(options))
    except ModelRefused as error:
        if options.json:
            _print_json(describe_refusal(Path(options.model).name, error.problems))
        raise
    if options.stage is not None:
        network = model.imported.network if options.stage == "imported" else model.network
        if options.json:
            _print_json({**describe(model), "stage": options.stage, "network": dump(network)})
        else:
            print(dump(network))
    elif options.json:
        _print_json(describe(model))
    else:
        print(as_text(describe(model)))
    return 0


def run_verify(options: argparse.Namespace) -> int:
    """``mn-onnx verify``: print the checks of a mesh file; returns 0, or raises `CheckFailed`."""
    from mn_onnx.verification import verify

    model = load(options.model, **_load_options(options))
    result = verify(options.mesh, model, tolerance=options.tolerance, threads=options.threads)
    if options.json:
        _print_json(result)
    else:
        print(_summary(options.mesh, result))
    if result["problems"]:
        raise CheckFailed(result["problems"])
    return 0


def run_bench(options: argparse.Namespace) -> int:
    """``mn-onnx bench``: print and write measurements; returns 0, or raises `CheckFailed` if some could not be made."""
    from rich.console import Console

    from mn_onnx.bench import BenchOptions, run_bench
    from mn_onnx.bench.extras import PLOTTING, require
    from mn_onnx.bench.plot import check_picture, plot
    from mn_onnx.bench.run import GRIDS
    from mn_onnx.bench.table import print_result

    if options.json is not None:
        _check_parent("--json", Path(options.json))
    if options.plot is not None:
        require(PLOTTING)
        _check_parent("--plot", Path(options.plot))
        check_picture(options.plot)
    settings = BenchOptions(
        grids=GRIDS if options.grids is None else options.grids,
        threads=options.threads,
        repeat=options.repeat,
        samples=options.samples,
        reference=options.reference,
        max_memory=_max_memory(options),
        load=_load_options(options),
    )
    with Console(stderr=True, quiet=options.quiet).status("start") as status:
        result = run_bench(options.models, settings, on_start=status.update)
    _write_report(options.json, result.as_dict())
    if options.plot is not None:
        plot(result, options.plot)
    if not options.quiet:
        print_result(result, Console())
    failures = [f"{model.model}: {failure}" for model in result.models for failure in model.failures]
    if failures:
        raise CheckFailed(failures)
    return 0


def _max_memory(options: argparse.Namespace) -> int | None:
    return None if options.max_memory is None else parse_size(options.max_memory)


def _load_options(options: argparse.Namespace) -> LoadOptions:
    bound = parse.bindings(options.bind)
    return {
        "output": options.output,
        "level": options.level,
        "bounds": options.bounds,
        "bind": bound if options.row is None else row_of(bound, options.row),
        "coordinates": parse.coordinates(options.coordinates),
        "surrogate_tol": options.surrogate_tol,
        "knots_per_period": options.knots_per_period,
        "budget": options.budget,
        "sign": options.sign,
    }


def _check_parent(option: str, path: Path) -> None:
    if path.is_dir():
        raise UsageError(f"{option} {path}: this is a folder")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{option} {path}: the folder {path.absolute().parent} does not exist")


def _write_report(target: str | None, report: Any) -> None:
    """Write ``report`` as JSON, whole or not at all; nothing if ``target`` is None."""
    if target is None:
        return
    path = Path(target)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
        partial.replace(path)
    except OSError as error:
        raise UsageError(f"cannot write the report {target}: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def _polish_line(polish: dict[str, Any]) -> str:
    held = f"; {polish['held_vertices']:,} vertices held back so that no face turns over" * bool(
        polish["held_vertices"]
    )
    stray = f"; {polish['stray_vertices']:,} found no root in reach" * bool(polish["stray_vertices"])
    return (
        f"  polished: mean |f_true| at vertices {polish['mean_abs_f_before']:.2g} before, {polish['mean_abs_f']:.2g} "
        f"after (max {polish['max_abs_f']:.2g}), on faces {polish['true_mean_abs_f']:.2g}; moved by up to "
        f"{polish['largest_move']:.2g}{held}{stray}"
    )


def _summary(mesh: str, report: dict[str, Any]) -> str:
    """A few lines about a mesh."""
    if report["unmatched_edges"]:
        closure = f"{report['unmatched_edges']:,} edges without neighbour"
    elif report["boundary_edges"]:
        closure = "closed but for where it leaves the box"
    else:
        closure = "closed"
    lines = [
        f"{mesh}: {report['polygons']:,} polygons, {report['vertices']:,} vertices, {report['components']} components, "
        f"Euler number {report['euler']}, {closure}"
    ]
    if report["max_abs_f"] is not None:
        lines.append(f"  |f| on the mesh: max {report['max_abs_f']:.2g}, mean {report['mean_abs_f']:.2g}")
    if not report["exact"]:
        lines.append(
            f"  surrogates within {report['surrogate_eps']:.2g} of the true network, whose |f - level| on the mesh is "
            f"{report['true_mean_abs_f']:.2g} in the mean"
            if report["true_mean_abs_f"] is not None
            else f"  surrogates within {report['surrogate_eps']:.2g} of the true network"
        )
    if report.get("surface_eps") is not None:
        lines.append(
            f"  on the mesh |f_true - f| is certified at most {report['surface_eps']:.2g} (median "
            f"{report['surface_eps_median']:.2g}); to first order the true surface is within "
            f"{report['displacement']:.2g} (median {report['displacement_median']:.2g})"
        )
    if report.get("polish") is not None:
        lines.append(_polish_line(report["polish"]))
    if report["parity_runtime"] is not None:
        lines.append(
            f"  {report['parity_runtime']}: differs by {report['parity_max_abs_err']:.2g} "
            f"({report['parity_allowed_err']:.2g} allowed), mean |f - level| {report['ort_mean_abs_f']:.2g}"
        )
    if "seconds" in report:
        lines.append("  " + ", ".join(f"{phase} {seconds:.2f} s" for phase, seconds in report["seconds"].items()))
    lines += [f"  note: {note}" for note in report["notes"]]
    return "\n".join(lines)
