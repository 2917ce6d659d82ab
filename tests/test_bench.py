"""The benchmark: what it measures is right, and what it writes is whole."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper
from rich.console import Console
from small_models import TILT, octahedron_model, refused_model

import mn_onnx
from mn_onnx.bench import cubes, extras
from mn_onnx.bench.options import BenchOptions
from mn_onnx.bench.quality import soft_precision, soft_recall
from mn_onnx.bench.result import BenchResult, Measurement, ModelResult
from mn_onnx.bench.run import in_fresh_process
from mn_onnx.bench.sampler import fastest, open_runtime
from mn_onnx.bench.table import markdown, print_result
from mn_onnx.bench.worker import Failure, Job
from mn_onnx.checks.runtime import Runtime
from mn_onnx.cli import EXIT_CHECK, EXIT_USAGE, main

Floats = NDArray[np.float64]
BOX = (np.full(3, -1.0), np.ones(3))


def save(path: Path, model: onnx.ModelProto) -> str:
    path.write_bytes(model.SerializeToString())
    return str(path)


def octahedron(points: Floats) -> Floats:
    return (np.abs(points @ TILT).sum(axis=1) - 0.5) / 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where one benchmark of the octahedron has left its files and its table."""
    folder = tmp_path_factory.mktemp("bench")
    path = save(folder / "octahedron.onnx", octahedron_model())
    mn_onnx.write_mesh(mn_onnx.extract(path), folder / "reference.ply", float64=True)
    arguments = [
        "--json",
        folder / "result.json",
        "--plot",
        folder / "result.png",
        "--reference",
        folder / "reference.ply",
    ]
    numbers = ["--grids", 16, 8, "--repeat", 2, "--samples", 4096, "--threads", 1]
    table = io.StringIO()
    with contextlib.redirect_stdout(table):
        assert main(["bench", path, *map(str, arguments), *map(str, numbers)]) == 0
    (folder / "table.txt").write_text(table.getvalue())
    return folder


@pytest.fixture
def result(folder: Path) -> Mapping[str, Any]:
    return json.loads((folder / "result.json").read_text())


def test_methods_are_measured_in_order_with_all_their_values(result: Mapping[str, Any]) -> None:
    (model,) = result["models"]
    assert (model["model"], model["failures"]) == ("octahedron.onnx", [])
    assert [(entry["method"], entry["resolution"]) for entry in model["measurements"]] == [
        ("exact", None), ("marching cubes", 8), ("marching cubes", 16),
    ]  # fmt: skip
    exact, *sampled = model["measurements"]
    assert {"traverse", "weld", "tessellate"} <= exact["seconds"].keys()
    assert all(entry["seconds"].keys() == {"evaluate", "triangulate"} for entry in sampled)
    assert exact["preparation"].keys() == {"import", "lower"}
    for entry in model["measurements"]:
        assert entry["total"] > 0
        assert entry["warm_up"] > 0
        assert entry["peak_bytes"] >= entry["idle_bytes"] > 20_000_000
    assert (exact["polygons"], exact["triangles"], exact["vertices"]) == (8, 8, 6)
    assert (exact["components"], exact["euler"]) == (1, 2)
    assert model["ratios"] == {
        str(entry["resolution"]): pytest.approx(exact["total"] / entry["total"]) for entry in sampled
    }
    assert (result["threads"], result["repeat"], result["samples"]) == (1, 2, 4096)


def test_errors_shrink_with_the_grid_and_vanish_where_exact(result: Mapping[str, Any]) -> None:
    exact, coarse, fine = result["models"][0]["measurements"]
    for quality in ("soft_precision", "soft_recall"):
        assert exact[quality] < 1e-15 < 1e-4 < fine[quality] < coarse[quality] < 0.2


def test_the_plot_is_a_picture(folder: Path) -> None:
    from matplotlib.image import imread

    picture = imread(folder / "result.png")
    assert picture.shape[:2] == (600, 960)
    assert picture[..., :3].std() > 0.01


def test_a_table_is_printed(folder: Path) -> None:
    table = (folder / "table.txt").read_text()
    assert "…" not in table  # eighty columns suffice
    for words in ("octahedron.onnx, 1 threads, median of 2", "marching cubes 8^3", "exact: traverse", "before: import"):
        assert words in table


def test_large_numbers_fit_into_eighty_columns() -> None:
    values = {"polygons": 5_657_854, "triangles": 11_315_704, "vertices": 5_657_850, "corners": 22_631_412}
    times = {"preparation": {}, "warm_up": 0.3, "seconds": {}, "peak_bytes": 3 << 30, "idle_bytes": 1 << 28}
    quality = {"components": 1, "euler": 2, "soft_precision": 1.2e-16, "soft_recall": 0.00012}
    exact = Measurement("exact", None, **times, total=289.123, **values, **quality)  # type: ignore[arg-type]
    sampled = dataclasses.replace(exact, method="marching cubes", resolution=512, total=1234.567)
    result = BenchResult({}, 2, 3, 1000, "bunny.ply", [ModelResult("bunny.onnx", "", [exact, sampled])])
    table = io.StringIO()
    print_result(result, Console(file=table, width=80))
    assert "marching cubes 512^3  1234.567   0.23  3.0 GiB  11,315,704   1.2e-16  0.00012" in table.getvalue()


def test_slabs_give_the_triangles_of_the_whole_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = cubes.marching_cubes(octahedron, 0.0, *BOX, 20)
    monkeypatch.setattr(cubes, "SLAB_SAMPLES", 4 * 20**2)
    monkeypatch.setattr(cubes, "BLOCK_SAMPLES", 2 * 20**2)
    slabs = cubes.marching_cubes(octahedron, 0.0, *BOX, 20)

    def area(mesh: cubes.Cubes) -> float:
        corners = mesh.vertices[mesh.triangles]
        return float(
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        )

    assert len(slabs.vertices) > len(whole.vertices)  # those of the layers that slabs share
    assert len(slabs.triangles) == len(whole.triangles) > 0
    assert area(slabs) == pytest.approx(area(whole), rel=1e-5)
    assert np.abs(octahedron(slabs.vertices)).max() < 1e-6 + 0.15 / 20


def test_a_grid_without_surface_gives_no_triangles() -> None:
    mesh = cubes.marching_cubes(octahedron, 5.0, *BOX, 8)
    assert (len(mesh.vertices), len(mesh.triangles)) == (0, 0)


def test_quality_of_a_shifted_mesh_is_its_shift() -> None:
    model = mn_onnx.load(octahedron_model())
    surface = mn_onnx.extract(model)
    points = surface.vertices + np.array([0.0, 0.0, 2.0])
    apart = np.linalg.norm(points[:, None] - surface.vertices[None], axis=2).min(axis=1)
    recall = soft_recall(points, surface)
    assert recall is not None
    assert 1.4 < recall <= apart.mean()
    level_off = mn_onnx.load(octahedron_model(), level=0.01)
    assert soft_precision(level_off, surface, 1000) == pytest.approx(0.01)


def fixed_batch(batch: int) -> onnx.ModelProto:
    model = octahedron_model()
    for value in (model.graph.input[0], model.graph.output[0]):
        value.type.tensor_type.shape.dim[0].dim_value = batch
    return model


def test_a_fixed_batch_is_freed_where_that_changes_nothing() -> None:
    model = mn_onnx.load(fixed_batch(2))
    runtime, note = open_runtime(model, {}, 1)
    assert "batch freed" in note
    sampler = fastest(runtime, note, *BOX)
    points = np.random.default_rng(1).uniform(-1, 1, (1000, 3))
    np.testing.assert_allclose(sampler.evaluate(points), octahedron(points), atol=1e-6)
    stored = Runtime(model.read, model.imported.layout)
    assert sampler.runtime.most_points > stored.most_points


def test_a_batch_that_the_graph_needs_stays() -> None:
    model = fixed_batch(2)
    shape = helper.make_tensor("six", TensorProto.INT64, [1], [6])
    back = helper.make_tensor("pairs", TensorProto.INT64, [2], [2, 3])
    model.graph.initializer.extend([shape, back])
    model.graph.node.insert(0, helper.make_node("Reshape", ["x", "six"], ["flat"], name="flatten"))
    model.graph.node.insert(1, helper.make_node("Reshape", ["flat", "pairs"], ["again"], name="restore"))
    model.graph.node[2].input[0] = "again"
    runtime, note = open_runtime(mn_onnx.load(model), {}, 1)
    assert "slows" in note
    points = np.random.default_rng(1).uniform(-1, 1, (5, 3))
    np.testing.assert_allclose(runtime.evaluate(points), octahedron(points), atol=1e-6)


def test_missing_packages_are_named_with_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    present = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in ("skimage", "igl") else present(name))
    model, mesh = str(folder / "octahedron.onnx"), str(folder / "reference.ply")
    assert main(["bench", model]) == EXIT_USAGE
    assert "pip install scikit-image\n" in capsys.readouterr().err
    assert main(["bench", model, "--reference", mesh]) == EXIT_USAGE
    assert "pip install libigl scikit-image\n" in capsys.readouterr().err


def test_all_unusable_models_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused = save(tmp_path / "refused.onnx", refused_model())
    assert main(["bench", refused, str(tmp_path / "gone.onnx")]) == EXIT_USAGE
    message = capsys.readouterr().err
    for words in ("refused.onnx", "second_product", "gone.onnx"):
        assert words in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--grids", "1"], "grid"),
        (["--repeat", "0"], "repeat"),
        (["--threads", "0", "--samples", "0"], "samples must be at least 1, not 0; threads must be at least 1"),
        (["--reference", "gone.ply"], "gone.ply"),
        (["--json", "gone/result.json"], "--json"),
        (["--plot", "gone/result.png"], "--plot"),
        (["--plot", "result.xyz"], ".png"),
        (["--max-memory", "much"], "much"),
    ],
)
def test_wrong_usage_is_told_before_any_measurement(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main(["bench", str(folder / "octahedron.onnx"), *arguments]) == EXIT_USAGE
    assert words in capsys.readouterr().err


def test_what_fails_is_told_beside_what_was_measured(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = tmp_path / "result.json"
    arguments = ["--grids", "8", "--repeat", "1", "--samples", "100", "--max-memory", "50MB", "--json", str(found)]
    assert main(["bench", str(folder / "octahedron.onnx"), *arguments]) == EXIT_CHECK
    assert "octahedron.onnx: exact: the mesh does not fit" in capsys.readouterr().err
    (model,) = json.loads(found.read_text())["models"]
    assert [entry["resolution"] for entry in model["measurements"]] == [8]
    assert len(model["failures"]) == 1
    assert model["ratios"] == {}


class Deadly:
    """Ends the process that receives it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return signal.raise_signal, (signal.SIGKILL,)


def test_a_process_that_dies_is_a_failure() -> None:
    options = BenchOptions(repeat=1, samples=100, load={"level": Deadly()})  # type: ignore[typeddict-item]
    job = Job("gone.onnx", 8, 1, options)
    outcome = in_fresh_process(job)
    assert isinstance(outcome, Failure)
    assert (
        outcome.reason
        == "marching cubes 8^3: the process ended with code -9: it was killed, perhaps for lack of memory"
    )


def test_the_readme_table_has_a_row_per_model() -> None:
    def measurement(resolution: int | None, total: float) -> Measurement:
        return Measurement(
            method="exact" if resolution is None else "marching cubes",
            resolution=resolution,
            preparation={},
            warm_up=0.0,
            seconds={"all": total},
            total=total,
            peak_bytes=300 * 1024**2,
            idle_bytes=0,
            polygons=158790,
            triangles=9,
            vertices=7,
            corners=27,
            components=1,
            euler=2,
            soft_precision=1.3e-4,
            soft_recall=None,
        )

    good = ModelResult("good.onnx", "", [measurement(None, 0.5), measurement(64, 0.25), measurement(128, 2.0)])
    bad = ModelResult("bad.onnx", "", [measurement(64, 0.25), measurement(128, 2.0)], ["exact: out of memory"])
    machine = {"versions": {"mn-onnx": "1"}, "cores": 2, "architecture": "x86_64"}
    lines = markdown(BenchResult(machine, 2, 3, 1000, None, [good, bad])).splitlines()
    assert lines[-2] == (
        "| `good` | 158,790 | 7 | 1 | 2 | 0.00013 | 300 MiB | 0.50 | 0.25 | 2.00 | 0.00013 | 0.00013 |"
    )
    assert lines[-1] == "| `bad` | exact: out of memory |"
    assert good.ratios == {64: 2.0, 128: 0.25}
