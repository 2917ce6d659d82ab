"""The canonical piecewise-linear IR of mn-onnx."""
