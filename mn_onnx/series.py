"""One mesh for each row of a table of codes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import UsageError

Floats = NDArray[np.float64]


def count_rows(bound: Mapping[str, Floats]) -> int:
    """The number of rows of the tables among ``bound``: the values with two axes or more.

    Raises `UsageError` if there is no table, or if they have different numbers of rows.
    """
    rows = {name: len(value) for name, value in bound.items() if value.ndim >= 2}
    if not rows:
        raise UsageError("rows of codes need a table: --bind NAME=codes.npy with an array of shape [rows, values]")
    if len(set(rows.values())) > 1:
        raise UsageError(f"the tables have different numbers of rows: {rows}")
    return next(iter(rows.values()))


def row_of(bound: Mapping[str, Floats], row: int) -> dict[str, Floats]:
    """``bound`` with row ``row`` of each table in its place. Raises `UsageError` if there is no such row."""
    n_rows = count_rows(bound)
    if not 0 <= row < n_rows:
        raise UsageError(f"there is no row {row}: the tables have rows 0 to {n_rows - 1}")
    return {name: value[row] if value.ndim >= 2 else value for name, value in bound.items()}


def numbered(path: str, row: int, n_rows: int) -> str:
    """The file of a row: ``path`` with its field filled in, as in ``mesh_{:03d}.ply``, or with ``-ROW`` before its end.

    Raises `UsageError` for a field that no number fits.
    """
    if "{" in path:
        try:
            filled = path.format(row)
        except (ValueError, IndexError, KeyError) as error:
            raise UsageError(f"{path}: the field for the row must be like {{:03d}} ({error})") from error
        return filled
    target = Path(path)
    return str(target.with_name(f"{target.stem}-{row:0{len(str(n_rows - 1))}d}{target.suffix}"))
