"""The traversal as its users call it: workers on threads, subtrees passed between them, output in canonical order.

A worker goes through its subtree depth first. When another worker has nothing to do, the worker gives away the cell at
the bottom of its stack: the largest piece of what it has left, and the last in its order. The polygons of that piece
come right after the giver's remaining ones, so the order of the output does not depend on who did what.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import (
    allowed_cores,
    block_count,
    index_dtype,
    keep_to_core,
    resolve_threads,
    run_blocks,
)
from mn_onnx.extract.kernels import control as entries
from mn_onnx.extract.kernels import march as kernel
from mn_onnx.extract.kernels.leaf import REMEMBERED
from mn_onnx.extract.kernels.memory import (
    CELL_END_F,
    CELL_END_I,
    CELL_FLOATS,
    CELL_SYSTEM_F,
    CELL_SYSTEM_I,
    J_REGIONS,
    SYS_FLOATS,
    SYS_INTS,
    SYS_UNITS,
    TRIMMED_DEPTHS,
    X_REGIONS,
    first_trim_tag,
    symbol_stride,
)
from mn_onnx.extract.kernels.records import OutputArrays, WorkerArrays
from mn_onnx.extract.kernels.slice_points import SLICE_FLOATS, SLICE_INTEGERS
from mn_onnx.extract.pack import Packed, pack
from mn_onnx.extract.soup import PolygonSoup
from mn_onnx.ir.network import Network

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LEAF_CHOICES = 8
# Cells with one in so many of the network's units left are large: see `how_to_bound` and LEAST_SETTLED.
LARGE_SHARE = 4
# Errors of every single unit are tracked in systems of so many levels and units, see `how_to_bound`: bounds of shallow
# systems are tight without, and for small ones it costs what it saves (measured: 16 to 32 units do equally well).
TRACKED_LEVELS, TRACKED_UNITS = 5, 24
# Work between two looks at the world, in weights: some ten milliseconds; and while another worker waits for work.
BUDGET, BUDGET_WHILE_ASKED = 64_000_000, 400_000
BUFFER_CORNERS = 1 << 17  # so that no array is so large that numpy asks for huge pages, which are slow to get
CORNERS_PER_POINT = 2  # that buffers have room for; mostly three or four corners lie at each point
_PART_CORNERS = 1 << 15  # of a full buffer, copied by one thread at a time


@dataclass
class TraversalStatistics:
    """What the traversal did; `mn_onnx.profile` describes ``profile`` and ``layers``."""

    nodes: int = 0
    pruned: int = 0
    trimmed: int = 0
    shaved: int = 0
    leaves: int = 0
    folds: int = 0
    broken_cuts: int = 0
    deepest: int = 0
    subtrees: int = 0
    threads: int = 1
    profile: Integers | None = None
    layers: Integers | None = None


@dataclass(frozen=True)
class Progress:
    """A snapshot of a running traversal."""

    nodes: int
    polygons: int
    corners: int


@dataclass
class _Chunk:
    sizes: NDArray[np.int32]
    gradients: Floats
    corners: NDArray[np.int32]
    positions: Floats
    keys: Integers
    box_faces: NDArray[np.int8]

    def copy(self) -> _Chunk:
        return _Chunk(*(getattr(self, field.name).copy() for field in fields(self)))


@dataclass
class _Task:
    """A subtree: a system and a cell as arena contents, and the polygons found in it so far."""

    F: Floats
    N: Integers
    root: int
    chunks: list[_Chunk] = field(default_factory=list)
    following: _Task | None = None


def _aligned_floats(size: int) -> Floats:
    """float64 [size], uninitialised, from the beginning of a cache line on."""
    line = 8
    room = np.empty(size + line)
    return room[-room.ctypes.data // room.itemsize % line :][:size]


class _Worker:
    """Owns arenas, and runs one task at a time."""

    def __init__(self, packed: Packed) -> None:
        largest = max(packed.rows, symbol_stride(packed.cols)) + 8
        self.packed = packed
        self.F = _aligned_floats(max(1 << 16, 2 * packed.F.size))
        self.N = np.empty(max(1 << 16, 2 * packed.N.size), np.int64)
        self.control = np.zeros(entries.CONTROL_SIZE, np.int64)
        self.control[entries.LEAF_CHOICES] = LEAF_CHOICES
        self.control[entries.TRACKED_LEVELS] = TRACKED_LEVELS
        self.control[entries.TRACKED_UNITS] = TRACKED_UNITS
        self.control[entries.LARGE_UNITS] = -(-int(packed.N[SYS_UNITS]) // LARGE_SHARE)
        self.stack = np.zeros(1024, np.int64)
        self.slot_of_tag = np.zeros(first_trim_tag(packed.tables.n_knots) + 2 * TRIMMED_DEPTHS, np.int64)
        self.remembered = np.zeros(REMEMBERED, np.int32)
        self._set_scratch(max(512, -(-largest // 8) * 8))
        self._set_output(BUFFER_CORNERS // 4, BUFFER_CORNERS)
        self.polygons = self.corners = 0

    def _set_scratch(self, region: int) -> None:
        self.X, self.slice_floats = (_aligned_floats(regions * region) for regions in (X_REGIONS, SLICE_FLOATS))
        self.X[:] = self.slice_floats[:] = 0.0
        self.J, self.slice_integers = (np.zeros(regions * region, np.int64) for regions in (J_REGIONS, SLICE_INTEGERS))

    def _set_output(self, polygons: int, corners: int) -> None:
        self.output = OutputArrays(
            np.zeros(3, np.int64),
            np.empty(polygons, np.int32),
            np.empty((polygons, 3)),
            np.empty(corners, np.int32),
            np.empty((corners // CORNERS_PER_POINT, 3)),
            np.empty((corners // CORNERS_PER_POINT, 2), np.int64),
            np.empty(corners, np.int8),
            self.remembered,
        )

    def start(self, task: _Task) -> None:
        self._reserve(2 * task.F.size, 2 * task.N.size)
        self.F[: task.F.size] = task.F
        self.N[: task.N.size] = task.N
        self.stack[0] = task.root
        self.control[entries.STACK_BOTTOM] = 0
        self.control[entries.STACK_TOP] = 1

    def _reserve(self, floats: int, integers: int) -> None:
        if floats > self.F.size:
            grown = _aligned_floats(floats + floats // 2)
            grown[: self.F.size] = self.F
            self.F = grown
        if integers > self.N.size:
            grown_i = np.empty(integers + integers // 2, np.int64)
            grown_i[: self.N.size] = self.N
            self.N = grown_i

    def flush(self, task: _Task) -> None:
        """Move the polygons in the buffers to the task: the buffers themselves if they are at least half full."""
        polygons, corners, points = (int(count) for count in self.output.counts)
        if not polygons:
            return
        out = self.output
        chunk = _Chunk(
            out.sizes[:polygons],
            out.gradients[:polygons],
            out.corners[:corners],
            out.positions[:points],
            out.keys[:points],
            out.box_faces[:corners],
        )
        if 2 * corners < out.box_faces.size:
            task.chunks.append(chunk.copy())
            out.counts[:] = 0
        else:
            task.chunks.append(chunk)
            self._set_output(out.sizes.size, out.box_faces.size)
        self.polygons += polygons
        self.corners += corners

    def run(self, task: _Task, budget: int) -> bool:
        """Work on the task for about ``budget``; True when it is finished or the worker was told to stop."""
        while True:
            arrays = WorkerArrays(
                self.F,
                self.N,
                self.X,
                self.J,
                self.control,
                self.stack,
                self.slot_of_tag,
                self.slice_floats,
                self.slice_integers,
            )
            status = kernel.march(arrays, self.packed.tables, self.output, budget)
            if status in (kernel.DONE, kernel.STOPPED):
                self.flush(task)
                return True
            if status == kernel.BUDGET_USED:
                return False
            if status == kernel.ARENA_FULL:
                self._reserve(int(self.control[entries.NEED_F]), int(self.control[entries.NEED_I]))
            elif status == kernel.SCRATCH_FULL:
                self._set_scratch(-(-2 * int(self.control[entries.NEED_I]) // 8) * 8)
            elif status == kernel.STACK_FULL:
                self.stack = np.concatenate([self.stack, np.zeros_like(self.stack)])
            else:
                self.flush(task)
                polygons, corners = int(self.control[entries.NEED_POLYGONS]), int(self.control[entries.NEED_CORNERS])
                out = self.output
                if polygons > out.sizes.size or corners > out.positions.shape[0]:
                    # Never smaller than before: `remembered` has numbers of points of the buffers before.
                    self._set_output(
                        max(2 * polygons, out.sizes.size), max(2 * CORNERS_PER_POINT * corners, out.corners.size)
                    )

    def give_away(self) -> _Task | None:
        """Take the bottom cell off the stack as a task of its own, if at least one other cell remains."""
        bottom, top = int(self.control[entries.STACK_BOTTOM]), int(self.control[entries.STACK_TOP])
        if top - bottom < 2:
            return None
        cell = int(self.stack[bottom])
        self.control[entries.STACK_BOTTOM] += 1
        header = self.N[cell : cell + CELL_END_I + 1]
        system_f, system_i = int(header[CELL_SYSTEM_F]), int(header[CELL_SYSTEM_I])
        floats, integers = int(self.N[system_i + SYS_FLOATS]), int(self.N[system_i + SYS_INTS])
        cell_f, end_f, end_i = int(header[CELL_FLOATS]), int(header[CELL_END_F]), int(header[CELL_END_I])
        F = np.concatenate([self.F[system_f : system_f + floats], self.F[cell_f:end_f]])
        N = np.concatenate([self.N[system_i : system_i + integers], self.N[cell:end_i]])
        N[integers + CELL_SYSTEM_F], N[integers + CELL_SYSTEM_I] = 0, 0
        N[integers + CELL_FLOATS] = floats
        N[integers + CELL_END_F], N[integers + CELL_END_I] = F.size, N.size
        return _Task(F, N, integers)


class _Pool:
    """Tasks waiting, workers idle, and the first error or interrupt."""

    def __init__(self, first: _Task, workers: list[_Worker]) -> None:
        self.condition = threading.Condition()
        self.waiting = [first]
        self.workers = workers
        self.idle = len(workers)
        self.subtrees = 1
        self.error: BaseException | None = None
        self.finished = False

    def take(self) -> _Task | None:
        """A task for an idle worker, which is busy from then on; None if there is nothing left to wait for."""
        with self.condition:
            while not self.waiting:
                if self.finished or self.error is not None or self.idle == len(self.workers):
                    self.finished = True
                    self.condition.notify_all()
                    return None
                self._ask()
                self.condition.wait()
            self.idle -= 1
            task = self.waiting.pop()
            if self.wants_more():
                self._ask()  # whoever looked while the task was waiting has seen nobody idle
            return task

    def _ask(self) -> None:
        for worker in self.workers:
            worker.control[entries.ASKED] = 1

    def finish(self) -> None:
        """A worker is done with its task."""
        with self.condition:
            self.idle += 1

    def wants_more(self) -> bool:
        return self.idle > len(self.waiting)

    def put(self, giver: _Task, task: _Task) -> None:
        with self.condition:
            task.following = giver.following
            giver.following = task
            self.waiting.append(task)
            self.subtrees += 1
            self.condition.notify()

    def fail(self, error: BaseException) -> None:
        with self.condition:
            self.error = self.error or error
            self.condition.notify_all()
        self.stop()

    def stop(self) -> None:
        """Tell all workers to stop."""
        for worker in self.workers:
            worker.control[entries.STOP] = 1


def traverse(
    network: Network,
    lower: Floats,
    upper: Floats,
    *,
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[PolygonSoup, TraversalStatistics]:
    """Find every polygon of the level set f = 0 of a canonical network in a box.

    ``lower``, ``upper``: float64 [3]. ``threads``: number of worker threads, all cores by default. The polygons do not
    depend on it; at which of several points of one key, apart by rounding, a corner lies may. ``progress`` is called
    from the calling thread a few times a second, and once at the end; what it raises stops the workers and is passed
    on.

    Raises ``ValueError`` for a network that is not canonical, an empty box or fewer than one thread. An interrupt
    (KeyboardInterrupt) stops all workers and is passed on.
    """
    packed = pack(network, lower, upper)
    count = resolve_threads(threads)
    first = _Task(packed.F, packed.N, packed.root)
    workers = [_Worker(packed) for _ in range(count)]
    pool = _Pool(first, workers)
    cores = allowed_cores()

    def work(number: int) -> None:
        worker = workers[number]
        try:
            keep_to_core(cores, number, count)
            while (task := pool.take()) is not None:
                worker.start(task)
                while not worker.run(task, BUDGET_WHILE_ASKED if pool.wants_more() else BUDGET):
                    if pool.wants_more() and (given := worker.give_away()) is not None:
                        pool.put(task, given)
                pool.finish()
        except BaseException as error:  # noqa: BLE001 - whatever it is, the caller gets it
            pool.fail(error)

    def report() -> None:
        if progress is not None:
            nodes = sum(int(worker.control[entries.NODES]) for worker in workers)
            polygons = sum(worker.polygons + int(worker.output.counts[0]) for worker in workers)
            corners = sum(worker.corners + int(worker.output.counts[1]) for worker in workers)
            progress(Progress(nodes, polygons, corners))

    crew = [threading.Thread(target=work, args=(number,), daemon=True) for number in range(count)]
    started = []
    try:
        for thread in crew:
            thread.start()
            started.append(thread)
        for thread in crew:
            while thread.is_alive():
                thread.join(0.2)
                report()
    finally:
        pool.stop()
        for thread in started:
            thread.join()
    if pool.error is not None:
        raise pool.error
    report()
    return _collect(first, count), _statistics(workers, pool)


def _statistics(workers: list[_Worker], pool: _Pool) -> TraversalStatistics:
    def total(entry: int) -> int:
        return sum(int(worker.control[entry]) for worker in workers)

    profile = np.sum([worker.control[entries.PROFILE :] for worker in workers], axis=0).reshape(4, -1)
    return TraversalStatistics(
        nodes=total(entries.NODES),
        pruned=total(entries.PRUNED),
        trimmed=total(entries.TRIMMED),
        shaved=total(entries.SHAVED),
        leaves=total(entries.LEAVES),
        folds=total(entries.FOLDS),
        broken_cuts=total(entries.BROKEN_CUTS),
        deepest=max(int(worker.control[entries.DEEPEST]) for worker in workers),
        subtrees=pool.subtrees,
        threads=len(workers),
        profile=profile[:2],
        layers=profile[2:],
    )


def _collect(first: _Task, threads: int) -> PolygonSoup:
    """The polygons of all tasks, taken out of them."""
    chunks: list[_Chunk] = []
    task: _Task | None = first
    while task is not None:
        chunks.extend(task.chunks)
        task.chunks.clear()
        task = task.following
    polygons = sum(chunk.sizes.size for chunk in chunks)
    corners = sum(chunk.corners.size for chunk in chunks)
    points = sum(chunk.positions.shape[0] for chunk in chunks)
    soup = PolygonSoup(
        np.zeros(polygons + 1, np.int64),
        np.empty(corners, index_dtype(points)),
        np.empty((points, 3)),
        np.empty((points, 2), np.uint64),
        np.empty(corners, np.int8),
        np.empty((polygons, 3)),
        np.zeros(polygons),
    )
    polygon = corner = point = 0
    parts: list[tuple[_Chunk, int, int, tuple[int, int, int]] | None] = []
    for chunk in chunks:
        count = block_count(chunk.corners.size, _PART_CORNERS)
        parts.extend((chunk, part, count, (polygon, corner, point)) for part in range(count))
        polygon += chunk.sizes.size
        corner += chunk.corners.size
        point += chunk.positions.shape[0]
    del chunks

    def place(begin: int, end: int) -> None:
        for number in range(begin, end):
            # A chunk is released with its last part, so that the soup and all chunks are never held together.
            part, parts[number] = parts[number], None
            if part is not None:
                _place_part(soup, *part)

    run_blocks(place, len(parts), threads)
    return soup


def _place_part(soup: PolygonSoup, chunk: _Chunk, part: int, parts: int, firsts: tuple[int, int, int]) -> None:
    """Copy one of so many equal parts of a chunk to the soup, where its first polygon, corner and point are."""
    polygon, corner, point = firsts
    polygons, corners, points = chunk.sizes.size, chunk.corners.size, chunk.positions.shape[0]
    if part == 0:
        ends = soup.offsets[polygon + 1 : polygon + polygons + 1]
        np.cumsum(chunk.sizes, out=ends)
        ends += corner
    begin, end = polygons * part // parts, polygons * (part + 1) // parts
    soup.gradients[polygon + begin : polygon + end] = chunk.gradients[begin:end]
    begin, end = corners * part // parts, corners * (part + 1) // parts
    np.add(chunk.corners[begin:end], point, out=soup.corners[corner + begin : corner + end], dtype=soup.corners.dtype)
    soup.box_faces[corner + begin : corner + end] = chunk.box_faces[begin:end]
    begin, end = points * part // parts, points * (part + 1) // parts
    soup.positions[point + begin : point + end] = chunk.positions[begin:end]
    soup.keys[point + begin : point + end] = chunk.keys[begin:end].view(np.uint64)
