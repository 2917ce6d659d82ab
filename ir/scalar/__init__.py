"""Scalar functions of one variable: evaluation, exact simplification, and rigorous enclosures."""

from mn_onnx.ir.scalar.evaluate import evaluate
from mn_onnx.ir.scalar.jet import Jet, jet
from mn_onnx.ir.scalar.kinks import UndefinedFunction, breakpoints, discontinuities
from mn_onnx.ir.scalar.rewrite import rewrite
from mn_onnx.ir.scalar.simplify import simplify

__all__ = [
    "Jet",
    "UndefinedFunction",
    "breakpoints",
    "discontinuities",
    "evaluate",
    "jet",
    "rewrite",
    "simplify",
]
