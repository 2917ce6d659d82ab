"""Exact extraction against marching cubes, on the user's machine: time, memory and error.

`run_bench` measures, each method in a fresh process; `mn_onnx.bench.table` and `mn_onnx.bench.plot` show the result.
Needs the extra ``bench``.
"""

from mn_onnx.bench.options import BenchOptions
from mn_onnx.bench.result import BenchResult, Measurement, ModelResult
from mn_onnx.bench.run import run_bench

__all__ = ["BenchOptions", "BenchResult", "Measurement", "ModelResult", "run_bench"]
