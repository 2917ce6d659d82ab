"""A first run, with no kernel compiled yet, on a machine without wide registers and with two cores."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

# Without a guard by __name__, as users write them.
SCRIPT = """
import json
import sys

import mn_onnx
from mn_onnx.extract import edges, invariants, measures, sampling, weld
from mn_onnx.extract.kernels import march
from mn_onnx.warmup import warm_up
from numba.core.registry import cpu_target

surface = warm_up(threads=2)
kernels = [march.march, weld._find_first_points, edges._pair_partitions, measures._measure, sampling._place]
compiled = {kernel.__name__: sum(kernel.stats.cache_misses.values()) for kernel in kernels}
fox = mn_onnx.extract(sys.argv[1], threads=1)
print(json.dumps({
    "features": cpu_target.target_context.codegen().magic_tuple()[2],
    "volume": surface.measures.volumes.sum(),
    "compiled": compiled,
    "fox": [fox.n_polygons, fox.n_vertices, fox.unmatched.size],
}))
"""


class FirstRun(NamedTuple):
    """What the script printed, and the names of the files that it left in numba's cache."""

    found: dict[str, Any]
    files: list[str]


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> FirstRun:
    folder = tmp_path_factory.mktemp("first_run")
    (folder / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(folder / "script.py"), str(Path(__file__).parents[1] / "models" / "niq_fox.onnx")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "NUMBA_CPU_NAME": "generic"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return FirstRun(json.loads(done.stdout), [file.name for file in folder.glob("cache/kernels_*/*.nbc")])


def test_two_processes_compile_every_kernel_once(first_run: FirstRun) -> None:
    assert first_run.found["volume"] == pytest.approx(1 / 6)  # of the octahedron
    assert first_run.found["compiled"] == {
        "march": 1, "_find_first_points": 0, "_pair_partitions": 0, "_measure": 0, "_place": 0,
    }  # fmt: skip
    # numba numbers the files of a kernel. A second one is for other types of arguments: a constant among them, or types
    # in which the second process compiles what the first calls in others, or never.
    assert len(first_run.files) > 50
    assert [name for name in first_run.files if not name.endswith(".1.nbc")] == []


def test_machines_without_wide_registers_find_the_same(first_run: FirstRun) -> None:
    assert "+avx512f" not in first_run.found["features"]
    assert first_run.found["fox"] == [28316, 28314, 0]
