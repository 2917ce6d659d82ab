"""Models straight from PyTorch: the module is exported to ONNX in memory."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from mn_onnx.errors import UsageError
from mn_onnx.model import LoadOptions, Model, load

if TYPE_CHECKING:
    import torch

OPSET = 17
EXAMPLE_POINTS = 2
"""Exporters take a batch of one for a fixed size."""


def from_torch(
    module: torch.nn.Module,
    *,
    input_dim: int = 3,
    inputs: Mapping[str, Any] | None = None,
    opset: int = OPSET,
    **options: Unpack[LoadOptions],
) -> Model:
    """Load a PyTorch module, as `load` does a file.

    ``module``: called with points, a tensor [n, input_dim], it returns the values [n] or [n, k]; put in evaluation mode
    for the export. ``inputs``: further arguments of its ``forward`` by name, in the order of the signature, tensors or
    arrays: constants such as a latent code. ``opset``: of the export. ``options``: as for `load`.

    Raises `UsageError` if PyTorch is missing or cannot export the module, and as `load`.
    """
    try:
        import torch
    except ImportError as error:
        raise UsageError("from_torch needs PyTorch: pip install 'mn-onnx[torch]'") from error
    bound = {name: torch.as_tensor(value) for name, value in (inputs or {}).items()}
    parameter = next(module.parameters(), None)
    dtype = torch.float32 if parameter is None else parameter.dtype
    device = torch.device("cpu") if parameter is None else parameter.device
    points = torch.zeros(EXAMPLE_POINTS, input_dim, dtype=dtype, device=device)
    arguments = (points, *(value.to(device) for value in bound.values()))
    was_training = module.training
    module.eval()
    try:
        data = _export(torch, module, arguments, ["points", *bound], opset)
    except Exception as error:  # exporters raise whatever a module leads them to
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UsageError(
            f"PyTorch cannot export {type(module).__name__} to ONNX: {first}; "
            "export it with torch.onnx.export and pass the file to load"
        ) from error
    finally:
        module.train(was_training)
    values = {name: value.detach().cpu().numpy() for name, value in bound.items()}
    options["bind"] = {**values, **(options.get("bind") or {})}
    return load(data, **options)


def _export(torch: Any, module: Any, arguments: tuple[Any, ...], names: list[str], opset: int) -> bytes:
    """The ONNX file of ``module`` with a free number of points, in memory.

    By the exporter from TorchScript where PyTorch still has it, since it needs no other package; else by the new one.
    """
    shared: dict[str, Any] = {"input_names": names, "output_names": ["value"], "opset_version": opset}
    buffer = io.BytesIO()
    try:
        torch.onnx.export(
            module, arguments, buffer, dynamo=False, dynamic_axes={"points": {0: "n"}, "value": {0: "n"}}, **shared
        )
        return buffer.getvalue()
    except (TypeError, torch.onnx.errors.OnnxExporterError):
        shapes = ({0: torch.export.Dim.DYNAMIC}, *({} for _ in arguments[1:]))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "module.onnx"
            torch.onnx.export(module, arguments, str(path), dynamo=True, dynamic_shapes=shapes, external_data=False,
                              **shared)  # fmt: skip
            return path.read_bytes()
