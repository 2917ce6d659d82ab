"""Benchmarks of the stages of extraction on the networks of models/, left out of the tests.

python -m pytest tests/benchmarks/bench_extraction.py
python -m pytest tests/benchmarks/bench_extraction.py --benchmark-autosave, later --benchmark-compare
"""

from __future__ import annotations

from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import mn_onnx
from mn_onnx.bench.cubes import marching_cubes
from mn_onnx.bench.sampler import Sampler, fastest, open_runtime
from mn_onnx.extract.blocks import resolve_threads
from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.pipeline import extract_surface
from mn_onnx.extract.schedule import traverse
from mn_onnx.extract.surface import Surface
from mn_onnx.extract.weld import weld
from mn_onnx.warmup import warm_up

MODELS = Path(__file__).resolve().parent.parent.parent / "models"
NAMES = ("bunny_relu_d3_w128", "bunny_relu_d4_w128", "am_chair", "niq_fox")
POLYGONS = {"bunny_relu_d3_w128": 158_790, "bunny_relu_d4_w128": 378_262, "am_chair": 248_228, "niq_fox": 28_316}
ROUNDS = 3


@pytest.fixture(scope="module", params=NAMES)
def model(request: pytest.FixtureRequest) -> mn_onnx.Model:
    warm_up().triangles()
    return mn_onnx.load(MODELS / f"{request.param}.onnx")


@pytest.fixture(scope="module")
def surface(model: mn_onnx.Model) -> Surface:
    return extract_surface(model.network, model.lower, model.upper).surface


@pytest.fixture(scope="module")
def sampler(model: mn_onnx.Model) -> Sampler:
    runtime, note = open_runtime(model, {}, resolve_threads(None))
    return fastest(runtime, note, model.lower, model.upper)


def polygons(model: mn_onnx.Model) -> int:
    return POLYGONS[model.read.name.removesuffix(".onnx")]


def test_load(benchmark: BenchmarkFixture, model: mn_onnx.Model) -> None:
    loaded = benchmark.pedantic(mn_onnx.load, args=(MODELS / model.read.name,), rounds=ROUNDS)
    assert loaded.exact


@pytest.mark.parametrize("threads", [1, 2])
def test_traverse(benchmark: BenchmarkFixture, model: mn_onnx.Model, threads: int) -> None:
    soup, _ = benchmark.pedantic(
        traverse, args=(model.network, model.lower, model.upper), kwargs={"threads": threads}, rounds=ROUNDS
    )
    assert soup.offsets.size - 1 == polygons(model)


@pytest.mark.parametrize("threads", [1, 2])
def test_weld(benchmark: BenchmarkFixture, model: mn_onnx.Model, threads: int) -> None:
    soup, _ = traverse(model.network, model.lower, model.upper)
    welded = benchmark.pedantic(weld, args=(soup,), kwargs={"threads": threads}, rounds=ROUNDS)
    assert welded.n_polygons == polygons(model)


def test_tessellate(benchmark: BenchmarkFixture, surface: Surface) -> None:
    triangles = benchmark.pedantic(surface.triangles, rounds=ROUNDS)
    assert len(triangles) == surface.n_corners - 2 * surface.n_polygons


def test_check_invariants(benchmark: BenchmarkFixture, model: mn_onnx.Model, surface: Surface) -> None:
    invariants = benchmark.pedantic(check_invariants, args=(surface,), kwargs={"bounds": model.bounds}, rounds=ROUNDS)
    assert invariants.closed


@pytest.mark.parametrize("resolution", [64, 128])
def test_marching_cubes(benchmark: BenchmarkFixture, model: mn_onnx.Model, sampler: Sampler, resolution: int) -> None:
    arguments = (sampler.evaluate, model.level, model.lower, model.upper, resolution)
    cubes = benchmark.pedantic(marching_cubes, args=arguments, rounds=ROUNDS)
    assert len(cubes.triangles) > resolution**2
