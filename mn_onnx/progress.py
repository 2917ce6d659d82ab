"""Progress of a long run: what the library reports, and the bar that the command line draws on a terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


@dataclass(frozen=True)
class ProgressEvent:
    """``phase``: import, lower, compile, traverse, weld, check or write; ``cells`` visited and ``polygons`` found."""

    phase: str
    cells: int = 0
    polygons: int = 0


ProgressCallback = Callable[[ProgressEvent], None]


class TerminalProgress:
    """A context manager that is a `ProgressCallback`: one line on standard error, or nothing if that is no terminal."""

    def __init__(self, *, enabled: bool) -> None:
        console = Console(stderr=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description:<9}"),
            TextColumn("{task.fields[cells]:>13,} cells"),
            TextColumn("{task.fields[polygons]:>11,} polygons"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not (enabled and console.is_terminal),
        )
        self._task = self._progress.add_task("start", total=None, cells=0, polygons=0)
        self._cells = self._polygons = 0

    def __enter__(self) -> Self:
        if not self._progress.disable:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        # Rich before version 14 ends even a bar that was never drawn with a new line.
        if not self._progress.disable:
            self._progress.stop()

    def __call__(self, event: ProgressEvent) -> None:
        # Phases after the traversal count nothing themselves: the bar keeps what was found.
        self._cells = max(self._cells, event.cells)
        self._polygons = max(self._polygons, event.polygons)
        self._progress.update(self._task, description=event.phase, cells=self._cells, polygons=self._polygons)
