"""The canonical piecewise-linear IR of mn-onnx.

`canonicalize` brings an imported `Network` into the form that the traversal takes; `mn_onnx.ir.spec` says what that
form is. Beside it stand evaluation (`mn_onnx.ir.evaluate`), certified bounds (`mn_onnx.ir.bounds`), certified errors of
surrogates (`mn_onnx.ir.certify`) and a readable dump (`mn_onnx.ir.text`).
"""

from mn_onnx.ir.expression import Expression
from mn_onnx.ir.network import AffineRow, KnotTable, Network, Unit
from mn_onnx.ir.passes import Canonical, canonicalize

__all__ = ["AffineRow", "Canonical", "Expression", "KnotTable", "Network", "Unit", "canonicalize"]
