"""The command line where it is used in unusual ways: numbers, files and signals."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx_models import float32, model_of, node
from small_models import octahedron_model

import mn_onnx
from mn_onnx.cli import EXIT_CHECK, EXIT_PIPE, EXIT_USAGE, main
from mn_onnx.errors import CheckFailed
from mn_onnx.extract import pipeline

COMMAND = [sys.executable, "-m", "mn_onnx"]


def written(path: Path, model: onnx.ModelProto) -> Path:
    path.write_bytes(model.SerializeToString())
    return path


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return written(tmp_path / "octahedron.onnx", octahedron_model())


def radial(size: float, *, opset: int = 17) -> onnx.ModelProto:
    """``sum of squares of size * x - 0.25``: smooth, with a round surface."""
    nodes = [
        node("Mul", ["x", "size"], ["t"]),
        node("Mul", ["t", "t"], ["q"]),
        node("ReduceSum", ["q", "axes"], ["s"]),
        node("Sub", ["s", "quarter"], ["y"]),
    ]
    constants = {"size": np.float32(size), "axes": np.array([1]), "quarter": np.float32(0.25)}
    return model_of(nodes, constants, opset=opset)


@pytest.mark.parametrize("numbers", [["--level", "-1e-3"], ["--bounds", "-1.", "1."], ["--bounds", "-.9e0", "1"]])
def test_negative_numbers_are_no_options(model: Path, tmp_path: Path, numbers: list[str]) -> None:
    assert main(["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--quiet", *numbers]) == 0


@pytest.mark.parametrize("report", ["mesh.ply", "./octahedron.onnx"])
def test_no_file_is_used_twice(
    model: Path, tmp_path: Path, report: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    before = model.read_bytes()
    assert main(["extract", str(model), "-o", "mesh.ply", "--report", report, "--quiet"]) == EXIT_USAGE
    assert "give two files" in capsys.readouterr().err
    assert model.read_bytes() == before
    assert not (tmp_path / "mesh.ply").exists()


def test_links_stay_and_what_is_no_file_is_written_through(model: Path, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    target, link, pipe = tmp_path / "folder" / "mesh.ply", tmp_path / "link.ply", tmp_path / "report.json"
    target.write_text("old")
    link.symlink_to(target)
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE) as reader:
        assert main(["extract", str(model), "-o", str(link), "--report", str(pipe), "--quiet"]) == 0
        assert reader.stdout is not None
        assert json.loads(reader.stdout.read())["polygons"] == 8
    assert link.is_symlink()
    assert target.read_bytes().startswith(b"ply")
    assert not pipe.is_file()


def test_output_that_nobody_reads_is_no_error(model: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*COMMAND, "inspect", str(model)], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert done.stderr == b""
    assert done.returncode == EXIT_PIPE


def test_far_surrogates_are_not_called_an_empty_level_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "radial.onnx", radial(1.0))
    arguments = ["extract", str(path), "-o", str(tmp_path / "mesh.ply"), "--quiet", "--bounds", "-20", "20"]
    assert main(arguments) == EXIT_CHECK
    message = capsys.readouterr().err
    assert "too coarse" in message
    assert "empty" not in message
    assert main([*arguments, "--knots-per-period", "500"]) == 0


def test_level_sets_without_a_border_are_not_called_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = [
        node("Abs", ["x"], ["a"]),
        node("ReduceMax", ["a"], ["m"], axes=[1]),
        node("Sub", ["m", "half"], ["d"]),
        node("Relu", ["d"], ["y"]),
    ]
    path = written(tmp_path / "flat.onnx", model_of(nodes, {"half": np.float32(0.5)}))
    assert main(["extract", str(path), "-o", str(tmp_path / "mesh.ply"), "--quiet"]) == EXIT_CHECK
    message = capsys.readouterr().err
    assert "reaches the level 0 but does not pass through it" in message
    assert "empty" not in message


def test_values_too_large_for_float64_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = {name: np.full((3, 3), 1e150) for name in "uvw"} | {"z": np.ones((3, 1))}
    nodes = [
        *(
            node("MatMul", [a, w], [b])
            for a, w, b in [("x", "u", "a"), ("r", "v", "b"), ("s", "w", "c"), ("c", "z", "y")]
        ),
        *(node("Relu", [a], [b]) for a, b in [("a", "r"), ("b", "s")]),
    ]
    types = {"x": onnx.TensorProto.DOUBLE, "y": onnx.TensorProto.DOUBLE}
    path = written(tmp_path / "large.onnx", model_of(nodes, weights, types=types))
    assert main(["inspect", str(path)]) == EXIT_USAGE
    assert "too large for float64" in capsys.readouterr().err


def test_smooth_networks_over_one_coordinate_have_roots(tmp_path: Path) -> None:
    nodes = [node("MatMul", ["x", "w"], ["h"]), node("Sin", ["h"], ["y"])]
    path = written(tmp_path / "sine.onnx", model_of(nodes, {"w": 4.0 * np.ones((1, 1), "f")}, inputs={"x": ("N", 1)}))
    roots = tmp_path / "roots.json"
    assert main(["extract", str(path), "-o", str(roots), "--quiet"]) == 0
    assert main(["inspect", str(path)]) == 0
    found = json.loads(roots.read_text())
    assert len(found["positions"]) == 3


def test_verify_knows_the_side_the_box_and_the_numbers_it_is_given(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = tmp_path / "mesh.ply"
    assert main(["extract", str(model), "-o", str(mesh), "--quiet"]) == 0
    assert main(["verify", str(mesh), str(model)]) == 0
    for arguments, code, reason in [
        (["--sign", "positive-inside"], EXIT_CHECK, "face the side where the field is smaller"),
        (["--bounds", "-0.1", "0.1"], EXIT_CHECK, "outside the box"),
        (["--tolerance", "nan"], EXIT_USAGE, "tolerance must be"),
        (["--tolerance", "-1"], EXIT_USAGE, "tolerance must be"),
        (["--threads", "0"], EXIT_USAGE, "threads must be"),
        (["--threads", "100000"], EXIT_USAGE, "threads must be"),
    ]:
        assert main(["verify", str(mesh), str(model), *arguments]) == code
        assert reason in capsys.readouterr().err
    nothing = tmp_path / "nothing.obj"
    nothing.write_text("v 0 0 0\n")
    assert main(["verify", str(nothing), str(model)]) != 0
    planar = written(
        tmp_path / "planar.onnx",
        model_of([node("MatMul", ["x", "w"], ["y"])], {"w": float32(2, 1)}, inputs={"x": ("N", 2)}),
    )
    assert main(["verify", str(mesh), str(planar)]) == EXIT_USAGE
    assert "2 coordinates" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("codes", "mesh", "reason"),
    [
        (np.zeros((0, 3)), "mesh.ply", "no rows"),
        (np.array([[0.0] * 3, [np.nan] * 3]), "mesh.ply", "not finite in rows 1"),
        (np.zeros((2, 3)), "mesh_{{}}.ply", "all rows would have the same file"),
        (np.zeros((2, 3)), "mesh_{0.foo}.ply", "the field for the row"),
        (np.zeros((2, 3)), "mesh_{0[1]}.ply", "the field for the row"),
    ],
    ids=["no rows", "not a number", "one file", "attribute", "item"],
)
def test_tables_and_names_that_do_not_fit_are_refused_before_the_work(
    codes: np.ndarray, mesh: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nodes = [node("Add", ["x", "code"], ["h"]), node("MatMul", ["h", "w"], ["y"])]
    inputs = {"x": ("N", 3), "code": (3,)}
    path = written(tmp_path / "coded.onnx", model_of(nodes, {"w": float32(3, 1)}, inputs=inputs))
    np.save(tmp_path / "codes.npy", codes)
    arguments = ["extract", str(path), "--all", "--bind", f"code={tmp_path / 'codes.npy'}", "--quiet"]
    assert main([*arguments, "-o", str(tmp_path / mesh)]) == EXIT_USAGE
    assert reason in capsys.readouterr().err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["coded.onnx", "codes.npy"]


def test_options_that_there_are_not_are_refused(model: Path) -> None:
    with pytest.raises(TypeError, match="levl"):
        mn_onnx.extract(model, levl=0.1)  # type: ignore[call-arg]


def test_a_cell_that_is_given_up_is_told(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    traverse = pipeline.traverse

    def giving_up(*arguments: object, **options: object) -> object:
        soup, statistics = traverse(*arguments, **options)  # type: ignore[arg-type]
        return soup, replace(statistics, broken_cuts=1)

    monkeypatch.setattr(pipeline, "traverse", giving_up)
    with pytest.raises(CheckFailed, match="1 cells could not be cut"):
        mn_onnx.extract(model, threads=1)
