"""What numba leaves to be done about its cache of compiled kernels: a place in every case, and no stale kernels."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
INSTALLED = frozenset(("site-packages", "dist-packages"))


def ensure_place_for_kernels(package: Path, user_cache: Path) -> Path | None:
    """Name a folder to numba where its own choice would not do: returns it, or None.

    numba keeps compiled kernels beside their source in ``package``, else below ``user_cache``, else it raises, as for
    a service that runs an installation of another user and has no home. In an installation they would outlast it: pip
    leaves what it does not know, and folders without sources hide an editable installation that follows.
    """
    if os.environ.get(VARIABLE):
        return None
    if INSTALLED.intersection(package.parts) and _takes_files(user_cache):
        folder = user_cache / "mn-onnx"
    elif _takes_files(package / "__pycache__") or _takes_files(user_cache):
        return None
    else:
        folder = _private_folder()
    os.environ[VARIABLE] = str(folder)
    if "numba" in sys.modules:  # it has read the environment already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def user_cache() -> Path:
    """The folder below the user's home in which numba keeps what finds no place beside its source."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or os.path.expanduser("~")
    elif sys.platform == "darwin":
        base = os.path.expanduser("~/Library/Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(base) / "numba"


def drop_stale_kernels(folder: Path) -> None:
    """Delete the compiled kernels of ``folder`` if any is older than any source there.

    numba compares a kernel with its own file only, not with the constants and kernels that it takes from others.
    """
    compiled = [*folder.glob("__pycache__/*.nbi"), *folder.glob("__pycache__/*.nbc")]
    if not compiled or not _takes_files(folder / "__pycache__"):  # what numba cannot write to it does not read
        return
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    if min(_modified(file) for file in compiled) < newest:
        for file in compiled:
            file.unlink(missing_ok=True)


def _modified(file: Path) -> float:
    """When ``file`` was written; never, if another process deletes it just now."""
    try:
        return file.stat().st_mtime
    except FileNotFoundError:
        return float("inf")


def _takes_files(folder: Path) -> bool:
    """Whether this process may write in ``folder``, or may create it."""
    existing = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def _private_folder() -> Path:
    """A folder for temporary files that no other user can write to: what numba reads from it is run."""
    import tempfile

    if not hasattr(os, "getuid"):  # Windows: the folder for temporary files is the user's own
        return Path(tempfile.gettempdir()) / "mn-onnx"
    folder = Path(tempfile.gettempdir()) / f"mn-onnx-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022:
        return folder
    return Path(tempfile.mkdtemp(prefix="mn-onnx-"))
