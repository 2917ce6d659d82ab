"""The traversal where rounding, huge numbers, or a worker that fails get in its way."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from mn_onnx.extract import schedule
from mn_onnx.extract.kernels import control as entries
from mn_onnx.extract.pack import pack
from mn_onnx.extract.schedule import traverse
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit

LOW, HIGH = -np.ones(3), np.ones(3)


def unit(weights: list[float], bias: float, knot: float = 0.0, columns: tuple[int, ...] = (0, 1, 2)) -> Unit:
    """``relu(t - knot)`` of ``t = weights . columns + bias``."""
    table = KnotTable.exact([knot], [[0.0, 1.0]], [[0.0, -knot]])
    return Unit(AffineRow(np.array(columns), np.array(weights), bias), (table,), "unit", table)


def plane_beside_knots_at_a_corner() -> Network:
    """A plane, and units whose knot is the largest value of their pre-activation, but for rounding."""
    random = np.random.default_rng(0)
    units: list[Unit] = []
    while len(units) < 5:
        slope, bias = random.uniform(0.1, 1.0, 2)
        knot = slope + bias
        if slope + (bias - knot) < 0.0:
            units.append(unit([slope, 0.0, 0.0], bias, knot))
    weights = np.concatenate([[0.0, 1.0, 0.013], np.full(len(units), 0.01)])
    return Network(3, tuple(units), AffineRow(np.arange(3 + len(units)), weights, 0.1))


@pytest.mark.parametrize("threads", [1, 3])
def test_no_cell_is_pushed_without_vertices(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    network = plane_beside_knots_at_a_corner()
    monkeypatch.setattr(schedule, "BUDGET", 250)
    monkeypatch.setattr(schedule, "BUDGET_WHILE_ASKED", 250)
    monkeypatch.setattr(schedule._Pool, "wants_more", lambda _: threads > 1)
    soup, statistics = traverse(network, LOW, HIGH, threads=threads)
    assert soup.offsets.tolist() == [0, 4]
    assert statistics.broken_cuts == 0


@pytest.mark.parametrize("size", [1e300, 1e308, 1.3e308])
def test_ranges_that_overflow_hide_no_surface(size: float) -> None:
    units = (unit([1.0, 0.01, 0.02], 0.0), unit([size], -0.001 * size, columns=(3,)))
    settled = tuple(unit([0.1 * k, 0.2, 0.3], 5.0) for k in (1, 2))
    network = Network(3, (units[0], *settled, units[1]), AffineRow(np.array([6]), np.array([1.0 / size]), -0.5))
    soup, _ = traverse(network, LOW, HIGH, threads=1)
    assert soup.offsets.size > 1


def test_a_worker_that_ends_while_it_is_asked_for_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    is_alive = threading.Thread.is_alive

    def late(thread: threading.Thread) -> bool:
        alive = is_alive(thread)
        time.sleep(0.002)
        return alive

    monkeypatch.setattr(threading.Thread, "is_alive", late)
    for _ in range(20):
        soup, _ = traverse(plane_beside_knots_at_a_corner(), LOW, HIGH, threads=2)
        assert soup.offsets.size == 2


def test_the_failure_of_a_worker_stops_the_others() -> None:
    packed = pack(plane_beside_knots_at_a_corner(), LOW, HIGH)
    workers = [schedule._Worker(packed) for _ in range(3)]
    pool = schedule._Pool(schedule._Task(packed.F, packed.N, packed.root), workers)
    assert [worker.control[entries.STOP] for worker in workers] == [0, 0, 0]
    pool.fail(MemoryError())
    assert [worker.control[entries.STOP] for worker in workers] == [1, 1, 1]
    assert isinstance(pool.error, MemoryError)
