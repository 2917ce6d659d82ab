"""Compiled kernels. They see flat arrays only.

Those of the traversal have `mn_onnx.extract.schedule` as their plain wrapper; `patches` and `neighbours` belong to
`mn_onnx.extract.smooth`.
"""
