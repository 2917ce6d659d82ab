"""One mesh for each row of a table of codes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from mn_onnx.errors import ModelRefused, UsageError
from mn_onnx.importer import Family, import_family
from mn_onnx.model import LoadOptions, Model, canonical_model, check_options, import_options, load
from mn_onnx.reader import ModelSource, ReadModel, read_model

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
    count = next(iter(rows.values()))
    if not count:
        raise UsageError(f"the tables have no rows: {', '.join(rows)}")
    return count


def row_of(bound: Mapping[str, Floats], row: int) -> dict[str, Floats]:
    """``bound`` with row ``row`` of each table in its place. Raises `UsageError` if there is no such row."""
    n_rows = count_rows(bound)
    if not 0 <= row < n_rows:
        raise UsageError(f"there is no row {row}: the tables have rows 0 to {n_rows - 1}")
    return {name: value[row] if value.ndim >= 2 else value for name, value in bound.items()}


class Series:
    """The models of all rows of the tables in ``options["bind"]``.

    ``source``: as of `mn_onnx.model.load`. The graph is lowered once, with the codes as parameters; where codes are
    multiplied with the point (FiLM layers, hypernetworks) it is piecewise linear for each code alone, and is lowered
    for each.

    Raises `UsageError` for tables that do not fit each other or hold numbers that are not finite, and as `load` for a
    model that cannot be read.
    """

    def __init__(self, source: ModelSource | ReadModel, **options: Unpack[LoadOptions]) -> None:
        check_options(options)
        self._bound = {name: np.asarray(value, np.float64) for name, value in (options.get("bind") or {}).items()}
        self.n_rows = count_rows(self._bound)
        for name, value in self._bound.items():
            if not np.isfinite(value).all():
                rows = np.unique(np.nonzero(~np.isfinite(value))[0]).tolist() if value.ndim >= 2 else []
                where = f" in rows {', '.join(map(str, rows[:10]))}" if rows else ""
                raise UsageError(f"{name!r} is bound to numbers that are not finite{where}")
        self._options = options
        self._read = source if isinstance(source, ReadModel) else read_model(source)

    @cached_property
    def _family(self) -> Family | None:
        tables = [name for name, value in self._bound.items() if value.ndim >= 2]
        try:
            return import_family(self._read.model, tables, **import_options(self._read, self._options_of(0)))
        except ModelRefused:
            return None

    def _options_of(self, row: int) -> LoadOptions:
        return {**self._options, "bind": row_of(self._bound, row)}

    def model(self, row: int) -> Model:
        """The model of one row. Raises as `load`."""
        started = time.perf_counter()
        options = self._options_of(row)
        if self._family is None:
            return load(self._read, **options)
        imported = self._family.member(row_of(self._bound, row))
        return canonical_model(self._read, imported, options, seconds=time.perf_counter() - started)


def numbered(path: str, n_rows: int) -> list[str]:
    """The file of every row: ``path`` with its field filled in, as in ``mesh_{:03d}.ply``, or ``-ROW`` before its end.

    Raises `UsageError` for a field that no number fits, and one that gives all rows the same file.
    """
    if "{" not in path:
        target, digits = Path(path), len(str(n_rows - 1))
        return [str(target.with_name(f"{target.stem}-{row:0{digits}d}{target.suffix}")) for row in range(n_rows)]
    try:
        filled = [path.format(row) for row in range(n_rows)]
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise UsageError(f"{path}: the field for the row must be like {{:03d}} ({error})") from error
    if len(set(filled)) < n_rows:
        raise UsageError(f"{path}: all rows would have the same file; give a field for the row, like {{:03d}}")
    return filled
