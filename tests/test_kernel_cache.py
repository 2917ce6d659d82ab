"""Compiled kernels find a place where neither installation nor home take files, and go when a source has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mn_onnx.kernel_cache import VARIABLE, drop_stale_kernels, ensure_place_for_kernels


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A path that no process can create, whoever runs it; and temporary files in a folder of the test's own."""
    monkeypatch.setenv(VARIABLE, "")  # as good as unset, and taken back after the test
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    (tmp_path / "file").write_bytes(b"")
    return tmp_path / "file" / "folder"


def test_numba_is_left_alone_where_it_finds_a_place(nowhere: Path, tmp_path: Path) -> None:
    assert ensure_place_for_kernels(tmp_path, nowhere) is None
    assert ensure_place_for_kernels(nowhere, tmp_path / "cache" / "numba") is None
    assert not os.environ[VARIABLE]


def test_a_folder_that_the_user_names_is_kept(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "chosen")
    assert ensure_place_for_kernels(nowhere, nowhere) is None
    assert os.environ[VARIABLE] == "chosen"


def test_an_installation_keeps_no_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    installed, cache = tmp_path / "site-packages" / "mn_onnx", tmp_path / "cache" / "numba"
    installed.mkdir(parents=True)
    assert ensure_place_for_kernels(installed, cache) == cache / "mn-onnx"
    assert os.environ[VARIABLE] == str(cache / "mn-onnx")


def test_kernels_are_cached_in_a_private_folder_else(nowhere: Path, tmp_path: Path) -> None:
    folder = ensure_place_for_kernels(nowhere, nowhere)
    assert folder is not None
    assert folder.parent == tmp_path
    source = tmp_path / "kernel.py"
    source.write_text("import numba\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\nprint(twice(21))\n")
    command = [sys.executable, str(source)]
    done = subprocess.run(command, env=os.environ, capture_output=True, text=True, check=True)
    assert done.stdout == "42\n"
    assert list(folder.rglob("*.nbi"))


def test_a_folder_that_others_can_write_to_is_not_trusted(nowhere: Path, tmp_path: Path) -> None:
    prepared = tmp_path / f"mn-onnx-{os.getuid()}"
    prepared.mkdir()
    prepared.chmod(0o777)
    folder = ensure_place_for_kernels(nowhere, nowhere)
    assert folder not in (None, prepared)
    assert folder is not None
    assert folder.stat().st_mode & 0o077 == 0


def test_a_change_of_any_source_drops_all_compiled_kernels(tmp_path: Path) -> None:
    sources = [tmp_path / name for name in ("constants.py", "kernel.py")]
    compiled = [tmp_path / "__pycache__" / name for name in ("kernel.nbi", "kernel.nbc")]
    other = tmp_path / "__pycache__" / "kernel.pyc"
    other.parent.mkdir()
    drop_stale_kernels(tmp_path)  # nothing there yet
    for time, file in enumerate([*sources, *compiled, other], start=1000):
        file.write_bytes(b"")
        os.utime(file, (time, time))
    drop_stale_kernels(tmp_path)
    assert all(file.exists() for file in compiled)
    os.utime(sources[0], (2000, 2000))
    drop_stale_kernels(tmp_path)
    assert [file.exists() for file in (*compiled, other)] == [False, False, True]
