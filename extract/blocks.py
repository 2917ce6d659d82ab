"""Fixed blocks of work on threads, and grouping of items by a small integer with a counting sort.

Kernels release the interpreter lock and write disjoint parts of their outputs. The blocks have a fixed size, never
one that depends on the number of threads, so that results are the same for any number of threads.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from mn_onnx.ir.kernel import threaded_kernel

BLOCK_SIZE = 1 << 16
"""Items per block: some hundred microseconds of work, so that handing it out costs nothing beside it."""

FINE_BLOCK = 1 << 12
"""Polygons or vertices per block: with larger ones a small mesh has too few for all threads."""

_TASKS_PER_THREAD = 4

Indices = NDArray[np.integer[Any]]


def resolve_threads(threads: int | None) -> int:
    """The number of threads to use: ``threads``, or all cores this process may run on.

    Raises ValueError below 1.
    """
    if threads is None:
        return len(allowed_cores()) or os.cpu_count() or 1
    if threads < 1:
        raise ValueError(f"threads is {threads}, but at least 1 is needed (None takes all cores)")
    return threads


def block_count(n_items: int, size: int = BLOCK_SIZE) -> int:
    """The number of blocks of ``size`` that cover ``n_items``."""
    return -(-n_items // size)


def run_blocks(work: Callable[[int, int], object], n_blocks: int, threads: int) -> None:
    """Call ``work(first, last)`` on ranges that cover the blocks ``0 .. n_blocks``, on ``threads`` threads.

    An exception in ``work``, or Ctrl-C in the main thread, cancels the ranges not yet begun and is raised.
    """
    n_tasks = max(1, min(n_blocks, threads * _TASKS_PER_THREAD))
    limits = [n_blocks * task // n_tasks for task in range(n_tasks + 1)]
    ranges = list(itertools.pairwise(limits))
    cores = allowed_cores()
    # On one core, as when a thread that keeps to one hands out work of its own, others would only take turns with it.
    if threads == 1 or n_tasks == 1 or len(cores) == 1:
        for first, last in ranges:
            work(first, last)
        return
    waiting = iter(ranges)  # threads take from it in turn: `next` is atomic under the interpreter's lock

    def work_on() -> None:
        try:
            for first, last in waiting:
                work(first, last)
        except BaseException:
            list(waiting)  # nothing is left for the other threads
            raise

    helpers = [_helpers(threads - 1, cores).submit(work_on) for _ in range(min(threads, n_tasks) - 1)]
    try:
        keep_to_core(cores, 0, threads)
        work_on()
    finally:
        # A helper that has not begun is not needed: all ranges are taken.
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
        allow_cores(cores)
    for helper in begun:
        helper.result()


@functools.cache
def _helpers(count: int, cores: tuple[int, ...]) -> ThreadPoolExecutor:
    """Threads that wait for work: starting new ones for every call would take longer than many calls' work."""
    numbers = itertools.count(1)
    return ThreadPoolExecutor(
        count, thread_name_prefix="blocks", initializer=lambda: keep_to_core(cores, next(numbers), count + 1)
    )


def allowed_cores() -> tuple[int, ...]:
    """The cores that the calling thread may run on; empty where the system does not tell."""
    return tuple(sorted(os.sched_getaffinity(0))) if sys.platform == "linux" else ()


def allow_cores(cores: tuple[int, ...]) -> None:
    """Let the calling thread run on these cores; does nothing if there are none, or if the system refuses."""
    if sys.platform == "linux" and cores:
        with contextlib.suppress(OSError):  # a sandbox may forbid it, and it is for speed only
            os.sched_setaffinity(0, cores)


def keep_to_core(cores: tuple[int, ...], number: int, threads: int) -> None:
    """Keep the calling thread, number so many of ``threads``, to a core of its own if the threads take all ``cores``.

    A scheduler may wake a thread on the core of the one that woke it, where they take turns for milliseconds while
    another core is idle. Measured: welding on two cores 29 instead of 35 ms.
    """
    if threads == len(cores):
        allow_cores(cores[number : number + 1])


def run_matrix_blocks(work: Callable[[int, int], object], n_blocks: int, threads: int) -> None:
    """`run_blocks` for work that multiplies matrices with numpy: each thread multiplies on its own.

    numpy's own threads, as many for every thread of ours, would wait for each other: 1.8 times slower on two cores.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        run_blocks(work, n_blocks, threads)


def run_matrix_parts(work: Callable[[slice], object], n_items: int, size: int, threads: int) -> None:
    """`run_matrix_blocks` on slices of ``size`` items each, one at a time.

    What is multiplied together, and so its rounding, does not depend on the threads.
    """

    def work_on(first: int, last: int) -> None:
        for block in range(first, last):
            work(slice(block * size, (block + 1) * size))

    run_matrix_blocks(work_on, block_count(n_items, size), threads)


def index_dtype(n_items: int) -> type[Any]:
    """int32 where it can number ``n_items``, else int64."""
    return np.int32 if n_items <= np.iinfo(np.int32).max else np.int64


@threaded_kernel
def _count_groups(
    groups: NDArray[np.uint16], block_size: int, first: int, last: int, counts: NDArray[np.int64]
) -> None:
    for block in range(first, last):
        for item in range(block * block_size, min((block + 1) * block_size, groups.size)):
            counts[block, groups[item]] += 1


@threaded_kernel
def _place_items(
    groups: NDArray[np.uint16], block_size: int, first: int, last: int, cursors: NDArray[np.int64], order: Indices
) -> None:
    for block in range(first, last):
        for item in range(block * block_size, min((block + 1) * block_size, groups.size)):
            group = groups[item]
            order[cursors[block, group]] = item
            cursors[block, group] += 1


def group_items(groups: NDArray[np.uint16], n_groups: int, threads: int) -> tuple[Indices, NDArray[np.int64]]:
    """Sort item numbers by group with a stable counting sort.

    ``groups``: uint16 [n], each below ``n_groups``. Returns ``order``, the item numbers (int32 or int64 [n]) by group
    and ascending within a group, and ``starts``, int64 [n_groups + 1]: group ``g`` is
    ``order[starts[g]:starts[g + 1]]``.
    """
    n_blocks = block_count(groups.size)
    counts = np.zeros((n_blocks, n_groups), np.int64)
    run_blocks(lambda first, last: _count_groups(groups, BLOCK_SIZE, first, last, counts), n_blocks, threads)
    starts = np.zeros(n_groups + 1, np.int64)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    cursors = np.cumsum(counts, axis=0)
    cursors -= counts
    cursors += starts[:-1]
    order = np.empty(groups.size, index_dtype(groups.size))
    run_blocks(lambda first, last: _place_items(groups, BLOCK_SIZE, first, last, cursors, order), n_blocks, threads)
    return order, starts
