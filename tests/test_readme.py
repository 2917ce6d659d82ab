"""The README holds: its tables are up to date, its example runs, its links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mn_onnx.operators import operator_table

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text()


def marked(mark: str) -> str:
    found = re.search(rf"<!-- {mark} -->\s*```\w+\n(.+?)\n```", TEXT, re.DOTALL)
    assert found is not None, f"README.md has no block marked {mark}"
    return found[1]


def test_the_table_of_operators_is_up_to_date() -> None:
    found = re.search(r"<!-- generated: operators -->\n(.*?)<!-- end -->", TEXT, re.DOTALL)
    assert found is not None
    assert found[1].strip() == operator_table(), "run: python models/update_readme.py operators"


def test_the_table_of_measurements_is_there() -> None:
    found = re.search(r"<!-- generated: measurements -->\n(.*?)<!-- end -->", TEXT, re.DOTALL)
    assert found is not None
    assert "| `bunny_relu_d3_w128` | 158,790 | 158,788 | 1 | 2 |" in found[1]


def test_the_library_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = marked("example: library")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    (tmp_path / "models").symlink_to(ROOT / "models")
    monkeypatch.chdir(tmp_path)
    scope: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), scope)
    assert (tmp_path / "bunny.obj").stat().st_size > 0
    assert len(scope["mesh"].faces) > scope["surface"].n_polygons == 158_790  # type: ignore[attr-defined]


@pytest.mark.parametrize("setup", ["mesh", "tests"])
def test_set_up_takes_one_command_each(setup: str) -> None:
    command = marked(f"setup: {setup}")
    assert "\n" not in command
    assert "pip install" in command


def test_local_links_and_named_files_exist() -> None:
    links = re.findall(r"\]\(((?!https?:)[^)#]+)\)", TEXT)
    assert links
    files = re.findall(r"`((?:mn_onnx|ir|extract|models)/[\w./]*)`", TEXT)
    missing = [name for name in links + files if not (ROOT / name).exists()]
    assert not missing
