"""Files of polylines: the format follows the file's extension."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.curve import Curve
from mn_onnx.extract.files.polygon_mesh import MeshFileError

STROKE = 1 / 400
"""Width of the lines in a drawing, relative to the longer side of the box."""


def write_curve(curve: Curve, path: str | os.PathLike[str]) -> None:
    """Write ``curve`` in the format of the extension of ``path``. The file appears whole or not at all.

    .svg: a drawing of the box, y upwards, {f < 0} shaded where all polylines are closed; coordinates have 9 digits.
    .json: ``lower`` and ``upper`` of the box and a list ``polylines``, each with ``closed`` and ``points``.
    .npz: the arrays of `Curve` by name. Both hold float64 exactly.

    Raises MeshFileError for an unknown extension or a folder that does not exist; OSError if writing fails.
    """
    target = Path(path)
    check_curve_path(target)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            _WRITERS[target.suffix.lower()](stream, curve)
        partial.replace(target)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def check_curve_path(path: str | os.PathLike[str]) -> None:
    """Raise MeshFileError, with all reasons, if `write_curve` could not write to ``path``."""
    target = Path(path)
    problems = []
    if target.suffix.lower() not in _WRITERS:
        found = f"ends in {target.suffix}" if target.suffix else "has no extension"
        problems.append(f"{target} {found}; a curve is written to {', '.join(_WRITERS)}")
    if not target.parent.is_dir():
        problems.append(f"the folder {target.parent} does not exist")
    elif target.is_dir():
        problems.append(f"{target} is a folder")
    if problems:
        raise MeshFileError("; ".join(problems))


def _write_svg(stream: BinaryIO, curve: Curve) -> None:
    width, height = curve.upper - curve.lower
    fill = "#dde6f0" if curve.closed.all() else "none"
    paths = " ".join(_svg_path(curve.polyline(index), curve.closed[index]) for index in range(curve.n_polylines))
    frame = f"{curve.lower[0]:.9g} {-curve.upper[1]:.9g} {width:.9g} {height:.9g}"
    stream.write(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{frame}">\n'
        f'<path transform="scale(1 -1)" fill="{fill}" fill-rule="evenodd" stroke="black"'
        f' stroke-width="{STROKE * max(width, height):.9g}" stroke-linejoin="round" d="{paths}"/>\n'
        "</svg>\n".encode()
    )


def _svg_path(points: NDArray[np.float64], closed: bool) -> str:
    corners = " ".join(f"{x:.9g},{y:.9g}" for x, y in points)
    return f"M{corners}Z" if closed else f"M{corners}"


def _write_json(stream: BinaryIO, curve: Curve) -> None:
    polylines = [
        {"closed": bool(curve.closed[index]), "points": curve.polyline(index).tolist()}
        for index in range(curve.n_polylines)
    ]
    box = {"lower": curve.lower.tolist(), "upper": curve.upper.tolist()}
    stream.write(json.dumps({**box, "polylines": polylines}).encode())


def _write_npz(stream: BinaryIO, curve: Curve) -> None:
    np.savez_compressed(
        stream,
        vertices=curve.vertices,
        segments=curve.segments,
        offsets=curve.offsets,
        closed=curve.closed,
        gradients=curve.gradients,
        errors=curve.errors,
        lower=curve.lower,
        upper=curve.upper,
    )


_WRITERS: Mapping[str, Callable[[BinaryIO, Curve], None]] = {
    ".svg": _write_svg,
    ".json": _write_json,
    ".npz": _write_npz,
}
