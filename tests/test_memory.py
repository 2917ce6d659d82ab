"""Memory limits: sizes as users write them, and a stop in time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_models import octahedron_model

import mn_onnx
from mn_onnx.cli import EXIT_MEMORY, EXIT_USAGE, main
from mn_onnx.errors import MemoryLimitReached, UsageError
from mn_onnx.memory import (
    WELDING_BYTES,
    MemoryLimit,
    available_memory,
    format_size,
    parse_size,
    peak_memory,
    resident_memory,
)

BUNNY = Path(__file__).resolve().parent.parent / "models" / "bunny_relu_d3_w128.onnx"


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("4GiB", 4 * 1024**3),
        ("4 gib", 4 * 1024**3),
        ("512MB", 512_000_000),
        ("1.5G", 1_500_000_000),
        ("2T", 2 * 10**12),
        ("100Ki", 102_400),
        ("123456", 123_456),
    ],
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "GiB", "-1G", "0", "4 parsecs", "1e9", "4GiBiB"])
def test_what_is_no_size_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="4GiB"):
        parse_size(text)


def test_sizes_are_shown_in_binary_units() -> None:
    assert format_size(3 * 1024**3 // 2) == "1.5 GiB"
    assert format_size(300 * 1024**2) == "300 MiB"


def test_the_peak_covers_memory_that_was_given_back() -> None:
    before = resident_memory()
    block = np.ones(8_000_000)
    during = resident_memory()
    del block
    peak = peak_memory()
    assert during - before > 60_000_000
    assert peak is not None
    assert peak >= during - 2_000_000  # the system counts in batches


def test_by_default_most_of_what_is_available_may_be_taken() -> None:
    limit = MemoryLimit.of(None).size - resident_memory()
    assert 0.7 * available_memory() < limit < 0.9 * available_memory()


def test_a_limit_counts_the_welding_to_come() -> None:
    limit = MemoryLimit(resident_memory() + 1_000_000_000)
    limit.check(0, 0)
    with pytest.raises(MemoryLimitReached, match=r"4,000,000 polygons.*\n.*--max-memory.*--bounds"):
        limit.check(4_000_000, 2_000_000_000 // WELDING_BYTES)


def test_extraction_stops_at_its_limit_and_leaves_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["extract", str(BUNNY), "-o", str(tmp_path / "mesh.ply"), "--max-memory", "50MB", "--no-check"]
    assert main(arguments) == EXIT_MEMORY
    message = capsys.readouterr().err
    assert "48 MiB" in message
    assert "--max-memory" in message
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MemoryLimitReached):
        mn_onnx.extract(octahedron_model(), max_memory=50_000_000)


def test_a_wrong_limit_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["extract", str(BUNNY), "-o", str(tmp_path / "mesh.ply"), "--max-memory", "much"]) == EXIT_USAGE
    assert "'much'" in capsys.readouterr().err
    with pytest.raises(UsageError, match="positive"):
        mn_onnx.extract(octahedron_model(), max_memory=0)


def test_an_allocation_that_fails_is_told_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def exhausted(*arguments: object, **options: object) -> None:
        raise MemoryError("Unable to allocate 1.00 TiB")

    monkeypatch.setattr("mn_onnx.commands.load", exhausted)
    assert main(["inspect", str(BUNNY)]) == EXIT_MEMORY
    assert "Unable to allocate 1.00 TiB\n  Fix: " in capsys.readouterr().err
