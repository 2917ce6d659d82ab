"""Files of polylines and of roots: the format follows the file's extension."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.files.polygon_mesh import MeshFileError
from mn_onnx.extract.files.whole import place_problems, written_whole
from mn_onnx.extract.planar.curve import Curve, Roots

STROKE = 1 / 400
"""Width of the lines in a drawing, relative to the longer side of the box."""


def write_curve(curve: Curve | Roots, path: str | os.PathLike[str]) -> None:
    """Write ``curve`` in the format of the extension of ``path``. The file appears whole or not at all.

    .svg: a drawing of the box, y upwards, {f < 0} shaded where all polylines are closed; coordinates have 9 digits.
    .json: ``lower`` and ``upper`` of the box and a list ``polylines``, each with ``closed`` and ``points``.
    .npz: the arrays of `Curve` by name. Both hold float64 exactly. Roots go to .json and .npz, by the names in `Roots`.

    Raises MeshFileError for an unknown extension or a folder that does not exist; OSError if writing fails.
    """
    target = Path(path)
    check_curve_path(target, 1 if isinstance(curve, Roots) else 2)
    with written_whole(target) as stream:
        if isinstance(curve, Roots):
            _ROOT_WRITERS[target.suffix.lower()](stream, curve)
        else:
            _CURVE_WRITERS[target.suffix.lower()](stream, curve)


def check_curve_path(path: str | os.PathLike[str], dimension: int = 2) -> None:
    """Raise MeshFileError, with all reasons, if `write_curve` could not write to ``path``.

    ``dimension``: 2 for a `Curve`, 1 for `Roots`.
    """
    target = Path(path)
    problems = []
    kind, writers = ("a curve", list(_CURVE_WRITERS)) if dimension == 2 else ("roots", list(_ROOT_WRITERS))
    if target.suffix.lower() not in writers:
        found = f"ends in {target.suffix}" if target.suffix else "has no extension"
        problems.append(f"{target} {found}; the level set of this model is {kind}, written to {', '.join(writers)}")
    problems += place_problems(target)
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


def _write_roots_json(stream: BinaryIO, roots: Roots) -> None:
    stream.write(json.dumps({name: values.tolist() for name, values in _arrays(roots).items()}).encode())


def _write_npz(stream: BinaryIO, level_set: Curve | Roots) -> None:
    arrays: dict[str, Any] = _arrays(level_set)  # numpy's stubs take any keyword for `allow_pickle`
    np.savez_compressed(stream, **arrays)


def _arrays(level_set: Curve | Roots) -> dict[str, NDArray[Any]]:
    """All fields, by name."""
    return {field.name: np.asarray(getattr(level_set, field.name)) for field in fields(level_set)}


_CURVE_WRITERS: Mapping[str, Callable[[BinaryIO, Curve], None]] = {
    ".svg": _write_svg,
    ".json": _write_json,
    ".npz": _write_npz,
}

_ROOT_WRITERS: Mapping[str, Callable[[BinaryIO, Roots], None]] = {
    ".json": _write_roots_json,
    ".npz": _write_npz,
}
