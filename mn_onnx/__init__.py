"""mn-onnx: exact level sets of networks exported to ONNX.

`extract` makes the mesh, `load` reads a model to look at it or to extract several times, `write_mesh` and `read_mesh`
store surfaces. Errors derive from `MnOnnxError`. Names are imported on first use, so that the command line starts fast.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import mn_onnx.extract as _extract_package
from mn_onnx.kernel_cache import drop_stale_kernels, ensure_place_for_kernels, user_cache

if TYPE_CHECKING:
    from mn_onnx.errors import CheckFailed, MemoryLimitReached, MnOnnxError, ModelRefused, Problem, UsageError
    from mn_onnx.extract.files import MeshFileError, read_mesh, write_mesh
    from mn_onnx.extract.surface import Surface
    from mn_onnx.extraction import extract
    from mn_onnx.model import Model, load
    from mn_onnx.planar import PlanarLevelSet, extract_planar
    from mn_onnx.torch_modules import from_torch

__version__ = "0.1.0"

_HOMES = {
    "CheckFailed": "mn_onnx.errors",
    "MemoryLimitReached": "mn_onnx.errors",
    "MeshFileError": "mn_onnx.extract.files",
    "MnOnnxError": "mn_onnx.errors",
    "Model": "mn_onnx.model",
    "ModelRefused": "mn_onnx.errors",
    "PlanarLevelSet": "mn_onnx.planar",
    "Problem": "mn_onnx.errors",
    "Surface": "mn_onnx.extract.surface",
    "UsageError": "mn_onnx.errors",
    "extract_planar": "mn_onnx.planar",
    "from_torch": "mn_onnx.torch_modules",
    "load": "mn_onnx.model",
    "read_mesh": "mn_onnx.extract.files",
    "write_mesh": "mn_onnx.extract.files",
}

__all__ = [
    "CheckFailed",
    "MemoryLimitReached",
    "MeshFileError",
    "MnOnnxError",
    "Model",
    "ModelRefused",
    "PlanarLevelSet",
    "Problem",
    "Surface",
    "UsageError",
    "extract",
    "extract_planar",
    "from_torch",
    "load",
    "read_mesh",
    "write_mesh",
]


class _CallablePackage(ModuleType):
    """Makes the package `mn_onnx.extract` callable, since the library's main function has the same name."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        from mn_onnx.extraction import extract

        return extract(*args, **options)


_extract_package.__class__ = _CallablePackage

ensure_place_for_kernels(Path(__file__).parent, user_cache())
drop_stale_kernels(Path(_extract_package.__path__[0], "kernels"))


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mn_onnx' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
