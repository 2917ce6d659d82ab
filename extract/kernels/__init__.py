"""Compiled kernels of the traversal. They see flat arrays only; `mn_onnx.extract.schedule` is their plain wrapper."""
