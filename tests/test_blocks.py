"""Work in fixed blocks on threads, and the counting sort."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

from mn_onnx.extract.blocks import (
    BLOCK_SIZE,
    allowed_cores,
    block_count,
    group_items,
    index_dtype,
    resolve_threads,
    run_blocks,
)


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("n_blocks", [0, 1, 3, 100])
def test_every_block_is_done_once(threads: int, n_blocks: int) -> None:
    done = np.zeros(n_blocks, np.int64)

    def work(first: int, last: int) -> None:
        done[first:last] += 1

    run_blocks(work, n_blocks, threads)
    assert (done == 1).all()


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_stops_what_has_not_begun_and_is_raised(threads: int) -> None:
    begun = []

    def work(first: int, last: int) -> None:
        begun.append(first)
        if first == 0:
            raise RuntimeError("no room")
        time.sleep(0.3)  # long enough for the calling thread to learn of the error

    with pytest.raises(RuntimeError, match="no room"):
        run_blocks(work, 10_000, threads)
    assert len(begun) <= 2 * threads  # of four ranges for each thread


def test_work_may_hand_out_work_of_its_own() -> None:
    done = np.zeros((6, 6), np.int64)

    def row(first: int, last: int) -> None:
        for index in range(first, last):

            def cell(begin: int, end: int, index: int = index) -> None:
                time.sleep(0.001)
                done[index, begin:end] += 1

            run_blocks(cell, 6, 2)

    run_blocks(row, 6, 2)
    assert (done == 1).all()


needs_two_cores = pytest.mark.skipif(len(allowed_cores()) < 2, reason="needs two cores, and a system that names them")


@needs_two_cores
def test_threads_that_take_all_cores_have_one_each() -> None:
    cores = allowed_cores()
    seen = []

    def work(first: int, last: int) -> None:
        time.sleep(0.02)
        seen.append(allowed_cores())

    run_blocks(work, 4 * len(cores), len(cores))
    assert set(seen) == {(core,) for core in cores}
    assert allowed_cores() == cores


@needs_two_cores
def test_the_caller_may_run_anywhere_again_after_an_error() -> None:
    cores = allowed_cores()

    def work(first: int, last: int) -> None:
        raise RuntimeError("no room")

    with pytest.raises(RuntimeError, match="no room"):
        run_blocks(work, 8, len(cores))
    assert allowed_cores() == cores


@needs_two_cores
def test_a_system_that_refuses_to_keep_threads_to_cores_still_gets_the_work_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(thread: int, cores: object) -> None:
        raise PermissionError("not here")

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    done = np.zeros(8, np.int64)

    def work(first: int, last: int) -> None:
        done[first:last] += 1

    run_blocks(work, 8, len(allowed_cores()))
    assert (done == 1).all()


@needs_two_cores
def test_other_numbers_of_threads_leave_it_to_the_system() -> None:
    cores = allowed_cores()
    seen = []
    run_blocks(lambda first, last: seen.append(allowed_cores()), 8, len(cores) + 1)
    assert set(seen) == {cores}


@pytest.mark.parametrize("n_items", [0, 1, 1000, 3 * BLOCK_SIZE + 17])
def test_grouping_is_a_stable_sort(n_items: int) -> None:
    groups = np.random.default_rng(n_items).integers(0, 37, n_items).astype(np.uint16)
    order, starts = group_items(groups, 37, 2)
    np.testing.assert_array_equal(order, np.argsort(groups, kind="stable"))
    np.testing.assert_array_equal(starts, np.searchsorted(np.sort(groups), np.arange(38)))


def test_blocks_cover_their_items() -> None:
    assert [block_count(n) for n in (0, 1, BLOCK_SIZE, BLOCK_SIZE + 1)] == [0, 1, 1, 2]


def test_indices_are_as_narrow_as_their_number_allows() -> None:
    assert index_dtype(2**31 - 1) is np.int32
    assert index_dtype(2**31) is np.int64


def test_senseless_numbers_of_threads_are_refused() -> None:
    assert resolve_threads(3) == 3
    assert resolve_threads(None) >= 1
    with pytest.raises(ValueError, match="at least 1"):
        resolve_threads(0)
