"""The command line as a user meets it: commands, files, messages, exit codes."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from small_models import octahedron_model, octahedron_volume, refused_model, shifted_model

from mn_onnx.cli import EXIT_CHECK, EXIT_INTERRUPTED, EXIT_USAGE, main
from mn_onnx.warmup import warm_up

ROOT = Path(__file__).resolve().parent.parent
COMMAND = [sys.executable, "-m", "mn_onnx"]


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """What is compiled here is found in the cache by the processes that the tests start."""
    warm_up()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "octahedron.onnx"
    path.write_bytes(octahedron_model().SerializeToString())
    return path


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False)


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix != ".onnx")


def test_extract_writes_mesh_and_report(model: Path, tmp_path: Path) -> None:
    result = run("extract", model, "-o", tmp_path / "mesh.ply", "--report", tmp_path / "report.json", "--float64")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert "8 polygons, 6 vertices, 1 components, Euler number 2, closed" in result.stdout
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply")
    assert mesh.volume == pytest.approx(octahedron_volume(), rel=1e-7)
    report = json.loads((tmp_path / "report.json").read_text())
    asked_for = {
        "polygons", "vertices", "edges", "euler", "components", "closed", "boundary_edges", "unmatched_edges",
        "max_abs_f", "mean_abs_f", "ort_mean_abs_f", "parity_max_abs_err", "nodes", "seconds", "exact", "surrogate_eps",
        "model_sha256", "versions",
    }  # fmt: skip
    assert asked_for <= report.keys()
    assert {"import", "lower", "compile", "traverse", "weld", "check", "write"} <= report["seconds"].keys()
    assert report["polygons"] == 8
    assert leftovers(tmp_path) == ["mesh.ply", "report.json"]


@pytest.mark.parametrize("extension", ["ply", "obj", "off", "stl", "glb", "3mf"])
def test_every_format_holds_the_same_surface(model: Path, tmp_path: Path, extension: str) -> None:
    path = tmp_path / f"mesh.{extension}"
    assert main(["extract", str(model), "-o", str(path), "--triangulate", "--quiet"]) == 0
    mesh = trimesh.load_mesh(path)
    mesh.merge_vertices()
    assert len(mesh.faces) == 8
    assert abs(mesh.volume) == pytest.approx(octahedron_volume(), rel=1e-5)
    assert main(["verify", str(path), str(model)]) == 0


def test_quiet_prints_nothing(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_bounds_level_output_and_binding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "shifted.onnx"
    path.write_bytes(shifted_model().SerializeToString())
    np.save(tmp_path / "shift.npy", np.array([0.05], np.float32))
    mesh = tmp_path / "mesh.off"
    for shift in ("0.05", tmp_path / "shift.npy"):
        arguments = ["--bind", f"shift={shift}", "--output", "fields:3", "--level", "0.1", "--bounds", "-1", "1"]
        assert main(["extract", str(path), "-o", str(mesh), *arguments]) == 0
        # y + 0.05 = 0.1 where sum |x| = 0.5 + 3 * 0.05
        assert trimesh.load_mesh(mesh).volume == pytest.approx(octahedron_volume(0.65), rel=1e-5)
    capsys.readouterr()
    half = ["--bounds", "-1", "1", "-1", "1", "0", "1"]
    assert main(["extract", str(path), "-o", str(mesh), "--output", "y", "--bind", "shift=0", *half]) == 0
    assert "leaves the box" in capsys.readouterr().out


def test_inspect_tells_what_the_model_is(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(model)]) == 0
    text = capsys.readouterr().out
    assert "exact" in text
    assert "3 units (3)" in text
    assert main(["inspect", str(model), "--json", "--level", "-0.2"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "exact"
    assert told["empty"]
    assert told["canonical"] == {"units": 3, "layers": [3], "knots": 3, "weights": 12}
    for stage in ("imported", "canonical"):
        assert main(["inspect", str(model), "--stage", stage]) == 0
        assert "3 units" in capsys.readouterr().out


def test_refusals_name_every_node(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "refused.onnx"
    path.write_bytes(refused_model().SerializeToString())
    result = run("extract", path, "-o", tmp_path / "mesh.ply")
    assert result.returncode == EXIT_USAGE
    for words in ("product (Mul, opset 13)", "second_product (Mul, opset 13)", "Fix:"):
        assert words in result.stderr
    assert "Traceback" not in result.stderr
    assert leftovers(tmp_path) == []
    assert main(["inspect", str(path), "--json"]) == EXIT_USAGE
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "refused"
    assert {problem["node"] for problem in told["problems"]} == {"product", "second_product"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["extract", "gone.onnx", "-o", "mesh.ply"], "gone.onnx"),
        (["extract", "MODEL", "-o", "mesh.xyz"], ".ply"),
        (["extract", "MODEL", "-o", "gone/mesh.ply"], "gone"),
        (["extract", "MODEL", "-o", "mesh.stl", "--float64"], "float32"),
        (["extract", "MODEL", "-o", "mesh.ply", "--report", "gone/report.json"], "--report"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bounds", "1", "-1"], "LOW < HIGH"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bounds", "-1", "0", "1"], "LOW HIGH"),
        (["extract", "MODEL", "-o", "mesh.ply", "--output", "z"], "'z'"),
        (["extract", "MODEL", "-o", "mesh.ply", "--output", "y:7"], "channel"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bind", "x"], "NAME=VALUE"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bind", "w=1"], "w"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bind", "w=gone.npy"], "gone.npy"),
        (["extract", "MODEL", "-o", "mesh.ply", "--bind", "w=word"], "word"),
        (["extract", "MODEL", "-o", "mesh.ply", "--coordinates", "0,0,1"], "--coordinates"),
        (["extract", "MODEL", "-o", "mesh.ply", "--threads", "0"], "threads"),
        (["verify", "gone.ply", "MODEL"], "gone.ply"),
        (["verify", "MODEL", "MODEL"], "mesh"),
    ],
)
def test_wrong_usage_ends_with_code_2_and_no_file(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: list[str], words: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main([argument.replace("MODEL", model.name) for argument in arguments]) == EXIT_USAGE
    assert words in capsys.readouterr().err
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("arguments", [[], ["extract"], ["extract", "m.onnx"], ["melt", "m.onnx"]])
def test_unknown_commands_and_missing_arguments_end_with_code_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == EXIT_USAGE


def test_an_empty_level_set_is_no_success(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "report.json"
    arguments = ["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--level", "-0.3", "--report", str(report)]
    assert main(arguments) == EXIT_CHECK
    message = capsys.readouterr().err
    assert "the level set is empty" in message
    assert "-0.16" in message  # the nearest value
    assert json.loads(report.read_text())["polygons"] == 0
    assert leftovers(tmp_path) == ["report.json"]


def test_a_failed_check_leaves_a_report_and_no_mesh_unless_told(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mn_onnx.extract.invariants import Invariants

    monkeypatch.setattr(Invariants, "problems", lambda self: ["a hole was found"])
    arguments = ["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--report", str(tmp_path / "report.json")]
    assert main(arguments) == EXIT_CHECK
    assert "a hole was found" in capsys.readouterr().err
    assert json.loads((tmp_path / "report.json").read_text())["problems"] == ["a hole was found"]
    assert leftovers(tmp_path) == ["report.json"]
    assert main([*arguments, "--no-check"]) == 0
    assert "warning: a hole was found" in capsys.readouterr().err
    assert leftovers(tmp_path) == ["mesh.ply", "report.json"]


def test_verify_tells_a_right_mesh_from_a_wrong_one(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = tmp_path / "mesh.ply"
    assert main(["extract", str(model), "-o", str(mesh), "--quiet"]) == 0
    assert main(["verify", str(mesh), str(model), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["problems"] == []
    assert told["closed"]
    right = trimesh.load_mesh(mesh)

    def save(change: Callable[[trimesh.Trimesh], trimesh.Trimesh]) -> str:
        change(right.copy()).export(tmp_path / "wrong.ply")
        return str(tmp_path / "wrong.ply")

    def grown(wrong: trimesh.Trimesh) -> trimesh.Trimesh:
        wrong.apply_scale(1.001)
        return wrong

    def holed(wrong: trimesh.Trimesh) -> trimesh.Trimesh:
        wrong.update_faces(np.arange(len(wrong.faces)) > 0)
        return wrong

    assert main(["verify", save(grown), str(model)]) == EXIT_CHECK
    assert "not the exact level set" in capsys.readouterr().err
    assert main(["verify", save(grown), str(model), "--tolerance", "1e-3"]) == 0
    assert main(["verify", save(holed), str(model)]) == EXIT_CHECK
    assert "have no neighbour" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_stops_at_once_and_leaves_nothing(number: signal.Signals, tmp_path: Path) -> None:
    command = [*COMMAND, "extract", str(ROOT / "models" / "bunny_relu_d4_w128.onnx"), "-o", str(tmp_path / "mesh.ply")]
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=end,
        env={**os.environ, "TERM": "xterm"},
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # whatever started the tests may ignore it
    )
    os.close(end)
    drawn = b""
    while b"traverse" not in drawn:
        drawn += os.read(terminal, 4096)
    interrupted = time.monotonic()
    process.send_signal(number)
    errors = rest_of(terminal)
    assert process.wait() == EXIT_INTERRUPTED
    assert time.monotonic() - interrupted < 2
    assert b"interrupted" in errors
    assert b"Traceback" not in errors
    assert list(tmp_path.iterdir()) == []


def rest_of(terminal: int) -> bytes:
    """What is still written to a terminal until its other end is closed."""
    written = b""
    try:
        while part := os.read(terminal, 4096):
            written += part
    except OSError:  # Linux reports the closed end as an error
        pass
    return written


def test_progress_is_drawn_on_a_terminal_only(model: Path, tmp_path: Path) -> None:
    arguments = [*COMMAND, "extract", str(model), "-o", str(tmp_path / "mesh.ply")]
    terminal, end = pty.openpty()
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=end, env={**os.environ, "TERM": "xterm"})
    os.close(end)
    drawn = rest_of(terminal)
    assert process.wait() == 0
    assert b"polygons" in drawn
    assert b"cells" in drawn
    assert run(*arguments[len(COMMAND) :]).stderr == ""


def test_help_comes_at_once() -> None:
    quickest = float("inf")
    for _ in range(3):
        started = time.monotonic()
        assert "extract" in run("--help").stdout
        quickest = min(quickest, time.monotonic() - started)
    assert quickest < 0.3


@pytest.mark.parametrize("name", ["eps", "displacement", "colour"])
def test_values_that_faces_will_not_have_are_refused_before_the_work(
    name: str, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--attributes", "normals", name]
    if name == "colour":  # argparse's own message
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
    else:
        assert main(arguments) == EXIT_USAGE
    assert "--attributes" in capsys.readouterr().err
    assert not (tmp_path / "mesh.ply").exists()
