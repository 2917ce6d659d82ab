"""Files that appear whole or not at all, and what can be told of a path before any work."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def written_whole(target: Path) -> Iterator[BinaryIO]:
    """A stream whose content becomes the file ``target`` at the end of the block, or nothing if that is left early.

    A link stays, and what it leads to is written. What is no file, as a pipe, is written as it comes.

    Raises OSError if writing fails.
    """
    if target.exists() and not target.is_file():
        with target.open("wb") as stream:
            yield stream
        return
    target = target.resolve()
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            yield stream
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def place_problems(target: Path) -> list[str]:
    """Why no file can be put at ``target``, a sentence each: by its folder, or because it is one itself."""
    folder = target.absolute().parent
    if not folder.is_dir():
        return [f"the folder {folder} does not exist; create it first"]
    if not os.access(folder, os.W_OK) and not target.exists():
        return [f"the folder {folder} cannot be written to"]
    return [f"{target} is a folder; add the name of a file"] if target.is_dir() else []
