"""The commands of the command line, each a function from parsed options to an exit code."""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mn_onnx import options as parse
from mn_onnx.errors import CheckFailed, ModelRefused, UsageError
from mn_onnx.memory import parse_size
from mn_onnx.model import LoadOptions, Model, load
from mn_onnx.progress import ProgressCallback
from mn_onnx.series import Series, numbered, row_of
from mn_onnx.summaries import mesh_summary, planar_summary


def run_extract(options: argparse.Namespace) -> int:
    """``mn-onnx extract``: write the mesh, and the report if asked; returns 0.

    Raises `CheckFailed`, after the report is written, if a check fails or the level set is empty; no mesh is then left.
    """
    if options.all:
        return _extract_rows(options)
    return _extract_one(options, lambda: load(options.model, **_load_options(options)))


def _extract_one(options: argparse.Namespace, load_model: Callable[[], Model]) -> int:
    """`run_extract` of the model that ``load_model`` gives."""
    from mn_onnx.extract.blocks import resolve_threads
    from mn_onnx.extract.files import check_mesh_options, write_mesh
    from mn_onnx.extraction import extract
    from mn_onnx.profile import profile_text
    from mn_onnx.progress import ProgressEvent, TerminalProgress

    _check_apart({"the model": options.model, "the mesh": options.mesh, "--report": options.report})
    if options.report is not None:
        _check_place("--report", options.report)
    with TerminalProgress(enabled=not options.quiet) as progress:
        progress(ProgressEvent("import"))
        model = load_model()
        if model.dimension < 3:
            return _extract_planar(options, model, progress)
        if model.fineness is not None and not options.quiet:
            cost = model.fineness.cost(resolve_threads(options.threads), polish=options.polish)
            print(f"mn-onnx: {cost}", file=sys.stderr)
        with _writing(options.mesh):
            check_mesh_options(options.mesh, float64=options.float64, attributes=options.attributes)
        _check_attributes(options.attributes, model)
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
        with _writing(options.mesh):
            write_mesh(
                surface,
                options.mesh,
                float64=options.float64,
                triangulate=options.triangulate,
                attributes=options.attributes,
            )
        report["seconds"] = {**report["seconds"], "write": time.perf_counter() - started}
    _write_report(options.report, report)
    for problem in report["problems"]:
        print(f"mn-onnx: warning: {problem}", file=sys.stderr)
    if options.profile:
        print(profile_text(report), file=sys.stderr)
    if not options.quiet:
        print(mesh_summary(options.mesh, report))
    return 0


def _extract_rows(options: argparse.Namespace) -> int:
    """`run_extract` for every row of the bound tables, of a graph that is read and lowered once."""
    if options.row is not None:
        raise UsageError("--all takes every row of the tables, --row one: give one of the two")
    series = Series(options.model, **_load_options(options))
    meshes = numbered(options.mesh, series.n_rows)
    reports = [None] * series.n_rows if options.report is None else numbered(options.report, series.n_rows)
    failures = []
    for row, (mesh, report) in enumerate(zip(meshes, reports, strict=True)):
        single = argparse.Namespace(**{**vars(options), "mesh": mesh, "report": report})
        try:
            _extract_one(single, functools.partial(series.model, row))
        except (CheckFailed, ModelRefused) as error:
            failures += [f"row {row}: {problem}" for problem in error.problems]
    if failures:
        raise CheckFailed(failures)
    return 0


def _extract_planar(options: argparse.Namespace, model: Model, progress: ProgressCallback) -> int:
    """`run_extract` for a network over one or two coordinates."""
    from mn_onnx.extract.planar.files import check_curve_path, write_curve
    from mn_onnx.planar import extract_planar
    from mn_onnx.progress import ProgressEvent

    asked = vars(options)
    useless = [f"--{name}" for name in ("triangulate", "float64", "attributes", "polish", "profile") if asked[name]]
    if useless:
        raise UsageError(f"{', '.join(useless)}: only for meshes, and this model is over {model.dimension} coordinates")
    with _writing(options.mesh):
        check_curve_path(options.mesh, model.dimension)
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
    with _writing(options.mesh):
        write_curve(found.level_set, options.mesh)
    if not options.quiet:
        print(planar_summary(options.mesh, found.report))
    return 0


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
    from mn_onnx.checks.verification import verify

    model = load(options.model, **_load_options(options))
    result = verify(options.mesh, model, tolerance=options.tolerance, threads=options.threads)
    if options.json:
        _print_json(result)
    else:
        print(mesh_summary(options.mesh, result))
    if result["problems"]:
        raise CheckFailed(result["problems"])
    return 0


def run_bench(options: argparse.Namespace) -> int:
    """``mn-onnx bench``: print and write measurements; returns 0, or raises `CheckFailed` if some could not be made."""
    from rich.console import Console

    from mn_onnx.bench import BenchOptions, run_bench
    from mn_onnx.bench.extras import PLOTTING, require
    from mn_onnx.bench.options import GRIDS
    from mn_onnx.bench.plot import check_picture, plot
    from mn_onnx.bench.table import print_result

    models = {f"model {number}": path for number, path in enumerate(options.models)}
    for model, path in models.items():
        _check_apart({model: path, "--json": options.json, "--plot": options.plot, "--reference": options.reference})
    if options.json is not None:
        _check_place("--json", options.json)
    if options.plot is not None:
        require(PLOTTING)
        _check_place("--plot", options.plot)
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
        with _writing(options.plot):
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


@contextmanager
def _writing(path: str) -> Iterator[None]:
    """Turns what can go wrong with the file ``path`` into a `UsageError`."""
    from mn_onnx.extract.files import MeshFileError

    try:
        yield
    except MeshFileError as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror or error}") from error


def _check_attributes(names: Sequence[str], model: Model) -> None:
    """Raise `UsageError` if a mesh of ``model`` will not have one of the values per face."""
    if model.exact and not {"eps", "displacement"}.isdisjoint(names):
        raise UsageError("--attributes: only networks with smooth activations have eps and displacement, not this one")


def _check_apart(paths: Mapping[str, str | None]) -> None:
    """Raise `UsageError` if two of the ``paths``, by what they are for, are the same file."""
    uses: dict[Path, str] = {}
    for use, path in paths.items():
        if path is None or path == os.devnull:
            continue
        other = uses.setdefault(Path(path).resolve(), use)
        if other != use:
            raise UsageError(f"{path} is both {other} and {use}: give two files")


def _check_place(option: str, path: str) -> None:
    from mn_onnx.extract.files.whole import place_problems

    for problem in place_problems(Path(path)):
        raise UsageError(f"{option} {path}: {problem}")


def _write_report(target: str | None, report: Any) -> None:
    """Write ``report`` as JSON, whole or not at all; nothing if ``target`` is None."""
    if target is None:
        return
    from mn_onnx.extract.files.whole import written_whole

    with _writing(target), written_whole(Path(target)) as stream:
        stream.write((json.dumps(report, indent=2, allow_nan=False) + "\n").encode())


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))
