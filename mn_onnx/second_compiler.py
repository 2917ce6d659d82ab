"""A second process that compiles: numba has one lock for all threads, but processes share its cache of kernels."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core import event

COMPILING = "numba:compile"  # the event that begins where a kernel is in no cache
# Seconds to wait for the second process, which should have ended by then.
PATIENCE = 60.0


@contextmanager
def compiling_beside(module: str) -> Iterator[None]:
    """As soon as anything is compiled in the context, run ``module`` in a second process, and wait for it at the end.

    ``module`` compiles other kernels than the context does, so that they are in the cache after it. Where no second
    process can run, nothing is lost but time: a kernel that is in no cache is compiled when it is called.
    """
    process = _ProcessAtEvent([sys.executable, "-P", "-m", module] if _is_interpreter(sys.executable) else None)
    patience = 0.0
    try:
        with event.install_listener(COMPILING, process):
            yield
        patience = PATIENCE
    finally:
        process.end(patience)


def _is_interpreter(executable: str | None) -> bool:
    """Whether ``executable`` runs modules: a program that embeds Python gives its own name, or none."""
    return bool(executable) and not hasattr(sys, "frozen") and Path(str(executable)).name.lower().startswith("python")


class _ProcessAtEvent(event.Listener):
    """Starts a process at the first event, if there is a ``command``."""

    def __init__(self, command: list[str] | None) -> None:
        self.command = command
        self.process: subprocess.Popen[bytes] | None = None

    def on_start(self, _: event.Event) -> None:
        if self.command is None:
            return
        command, self.command = self.command, None
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # of Windows
            )
        except OSError:  # this process compiles everything
            self.process = None

    def on_end(self, _: event.Event) -> None:
        """The process goes on: it has other kernels to compile."""

    def end(self, patience: float) -> None:
        """Wait for the process, at most ``patience`` seconds; what it has not compiled by then it never will."""
        if self.process is None:
            return
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
