"""The base of the errors that extraction and the layers above it raise on purpose."""

from __future__ import annotations


class MnOnnxError(Exception):
    """Base of all errors that mn-onnx raises on purpose."""
