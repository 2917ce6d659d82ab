"""How much memory a run takes and may take, and the stop before a machine begins to swap."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import psutil

from mn_onnx.errors import MemoryLimitReached, UsageError

SAFE_SHARE = 0.8
"""Part of the available memory that a run takes unless it is told otherwise."""

WELDING_BYTES = 60
"""Bytes per polygon corner that a process grows by after the traversal: measured, 25 to 50 to weld and check."""

POLISHED_BYTES = 700
"""Bytes per polygon of the polished mesh that a process grows by: measured, 600."""

_UNITS = {"": 1, "K": 1000, "M": 1000**2, "G": 1000**3, "T": 1000**4}
_UNITS |= {f"{letter}i": 1024**power for power, letter in enumerate("KMGT", start=1)}
_CGROUP = Path("/sys/fs/cgroup")


def parse_size(text: str) -> int:
    """Bytes in a size such as ``4GiB``, ``512MB``, ``2.5G`` or ``1000000``.

    Raises `UsageError` for anything else, and for sizes that are not positive.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]i?|)B?", text.strip(), re.IGNORECASE)
    size = int(float(found[1]) * _UNITS[found[2].upper().replace("I", "i")]) if found else 0
    if size <= 0:
        raise UsageError(f"the size {text!r} is not understood: expected a number with a unit, such as 4GiB or 512MB")
    return size


def format_size(size: int) -> str:
    """A size for people, in MiB or GiB."""
    return f"{size / 1024**3:.1f} GiB" if size >= 1024**3 else f"{size / 1024**2:.0f} MiB"


def available_memory() -> int:
    """Bytes that this process can take without swapping, in view of the machine and of its container."""
    available = int(psutil.virtual_memory().available)
    limit = _cgroup_entry("memory.max")
    if limit is None:
        return available
    # The cache of files counts as used, but is given back on demand.
    return max(0, min(available, limit - (_cgroup_entry("memory.current") or 0) + _reclaimable()))


def _cgroup_entry(name: str) -> int | None:
    """A number that the container (cgroup, version 2) tells; None without one."""
    path = _CGROUP / name
    text = path.read_text().strip() if path.is_file() else "max"
    return None if text == "max" else int(text)


def _reclaimable() -> int:
    statistics = (_CGROUP / "memory.stat").read_text().split()
    return int(statistics[statistics.index("inactive_file") + 1])


def resident_memory() -> int:
    """Bytes of memory that this process occupies now."""
    return int(psutil.Process().memory_info().rss)


def peak_memory() -> int | None:
    """The most bytes of memory that this process ever occupied; None where the system does not tell."""
    if psutil.LINUX:
        # Unlike getrusage, this starts anew with a new program: it does not inherit the peak of the parent process.
        found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
        return int(found[1]) * 1024 if found else None
    if psutil.MACOS:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return getattr(psutil.Process().memory_info(), "peak_wset", None)


@dataclass(frozen=True)
class MemoryLimit:
    """The most bytes of memory that the process may occupy."""

    size: int

    @classmethod
    def of(cls, size: int | None) -> MemoryLimit:
        """``size`` itself; without one, what is in use and `SAFE_SHARE` of what is available."""
        if size is not None and size <= 0:
            raise UsageError(f"max_memory must be a positive number of bytes, not {size}")
        return cls(size if size is not None else resident_memory() + int(SAFE_SHARE * available_memory()))

    def room(self, bytes_each: int) -> int:
        """How many things of ``bytes_each`` still fit."""
        return max(0, self.size - resident_memory()) // bytes_each

    def check(self, polygons: int, corners: int) -> None:
        """Raise `MemoryLimitReached` if the process, or the welding of what is found, needs more than is allowed."""
        used, welding = resident_memory(), WELDING_BYTES * corners
        if used + welding <= self.size:
            return
        raise MemoryLimitReached(
            f"the mesh does not fit in the memory allowed, {format_size(self.size)}: after {polygons:,} polygons "
            f"{format_size(used)} are in use, and welding these takes about {format_size(welding)}\n"
            f"  Fix: allow more with --max-memory ({format_size(available_memory())} are available now), "
            "or extract the box in parts with --bounds"
        )
