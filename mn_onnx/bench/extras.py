"""The packages that only the benchmark needs."""

from __future__ import annotations

from importlib.util import find_spec

from mn_onnx.errors import UsageError

SAMPLING = {"skimage": "scikit-image"}
"""Import names and package names of what marching cubes needs."""
PLOTTING = {"matplotlib": "matplotlib"}
RECALL = {"igl": "libigl"}


def require(packages: dict[str, str]) -> None:
    """Raise `UsageError` with the command to run if some of ``packages`` (import name: package) are not installed."""
    missing = sorted(package for name, package in packages.items() if find_spec(name) is None)
    if missing:
        raise UsageError(
            f"mn-onnx bench needs {' and '.join(missing)}, which the extra `bench` holds\n"
            f"  Fix: python3 -m pip install {' '.join(missing)}"
        )
