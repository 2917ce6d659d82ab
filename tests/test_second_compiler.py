"""A process beside this one compiles kernels, and does nothing where that is impossible or not needed."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from numba.core import event

from mn_onnx.second_compiler import COMPILING, compiling_beside


@pytest.fixture
def write_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Makes a module `task` that other processes find, which runs a line of code and then adds one to a file."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def write(line: str) -> Path:
        trace = tmp_path / "trace"
        (tmp_path / "task.py").write_text(f"{line}\nopen({str(trace)!r}, 'a').write('ran\\n')\n")
        return trace

    return write


def compile_something() -> None:
    event.start_event(COMPILING)
    event.end_event(COMPILING)


def compile_until_interrupted() -> None:
    with compiling_beside("task"):
        compile_something()
        raise KeyboardInterrupt


def test_the_process_runs_once_and_is_waited_for(write_task: Callable[[str], Path]) -> None:
    trace = write_task("import time; time.sleep(0.5)")
    with compiling_beside("task"):
        compile_something()
        compile_something()
    assert trace.read_text() == "ran\n"


def test_no_process_runs_where_nothing_is_compiled(write_task: Callable[[str], Path]) -> None:
    trace = write_task("")
    with compiling_beside("task"):
        pass
    compile_something()
    time.sleep(0.3)
    assert not trace.exists()


def test_a_process_that_fails_is_no_error(write_task: Callable[[str], Path]) -> None:
    trace = write_task("raise SystemExit(1)")
    with compiling_beside("task"):
        compile_something()
    assert not trace.exists()


@pytest.mark.parametrize("executable", ["", None, "modeller", "gone/python3"])
def test_no_process_runs_where_there_is_no_interpreter(
    executable: str | None, write_task: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    trace = write_task("")
    # A program that embeds Python would start once more.
    (tmp_path / "modeller").write_text(f"#!/bin/sh\necho ran > {trace}\n")
    (tmp_path / "modeller").chmod(0o755)
    monkeypatch.setattr(sys, "executable", executable and str(tmp_path / executable))
    with compiling_beside("task"):
        compile_something()
    assert not trace.exists()


def test_an_error_ends_the_process(write_task: Callable[[str], Path]) -> None:
    trace = write_task("import time; time.sleep(30)")
    started = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        compile_until_interrupted()
    assert time.perf_counter() - started < 20
    assert not trace.exists()
