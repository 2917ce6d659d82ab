"""What holds for all tests."""

from __future__ import annotations

from pathlib import Path

import mn_onnx.extract.kernels


def pytest_sessionstart() -> None:
    """Drop compiled kernels that are older than any kernel's source.

    numba's cache compares a kernel with its own file only, not with the constants and kernels it takes from others.
    """
    folder = Path(mn_onnx.extract.kernels.__file__).parent
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    compiled = [*folder.glob("__pycache__/*.nbi"), *folder.glob("__pycache__/*.nbc")]
    if any(file.stat().st_mtime < newest for file in compiled):
        for file in compiled:
            file.unlink(missing_ok=True)
