"""Sign conventions, and one mesh for each row of codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from smooth_models import soft_octahedron_model

from mn_onnx.cli import main
from mn_onnx.errors import UsageError
from mn_onnx.extract.files import read_mesh
from mn_onnx.extraction import extract
from mn_onnx.model import load
from mn_onnx.series import count_rows, numbered, row_of


@pytest.mark.parametrize(("scale", "sign"), [(1.0, "positive-outside"), (-1.0, "positive-inside")])
def test_sign_is_found_at_the_corners(scale: float, sign: str) -> None:
    surface = extract(
        soft_octahedron_model(scale=scale), bind={"code": [0.0]}, knots_per_period=4, threads=1, budget=1e5
    )
    assert surface.report["sign"] == sign
    assert surface.volume is not None
    assert surface.volume > 0


def test_a_sign_that_is_given_decides() -> None:
    options = {"bind": {"code": [0.0]}, "knots_per_period": 4}
    wrong = extract(soft_octahedron_model(), sign="positive-inside", threads=1, **options)
    assert wrong.volume is not None
    assert wrong.volume < 0
    with pytest.raises(UsageError, match="positive-outside"):
        load(soft_octahedron_model(), sign="inside", **options)


def test_one_mesh_for_each_row(tmp_path: Path) -> None:
    model, codes = tmp_path / "model.onnx", tmp_path / "codes.npy"
    onnx.save(soft_octahedron_model(), model)
    np.save(codes, np.array([[0.0], [0.4], [0.8]]))
    command = ["extract", str(model), "-o", str(tmp_path / "m_{:02d}.ply"), "--bind", f"code={codes}", "--all"]
    assert main([*command, "--knots-per-period", "4", "--quiet", "--report", str(tmp_path / "r.json")]) == 0
    areas = [read_mesh(tmp_path / f"m_{row:02d}.ply").area for row in range(3)]
    assert areas[0] > areas[1] > areas[2] > 0
    assert json.loads((tmp_path / "r-2.json").read_text())["closed"]


def test_rows_of_tables() -> None:
    bound = {"code": np.arange(6.0).reshape(3, 2), "time": np.float64(0.5).reshape(())}
    assert count_rows(bound) == 3
    assert row_of(bound, 1)["code"].tolist() == [2.0, 3.0]
    assert row_of(bound, 1)["time"] == 0.5
    with pytest.raises(UsageError, match="rows 0 to 2"):
        row_of(bound, 3)
    with pytest.raises(UsageError, match="need a table"):
        count_rows({"time": bound["time"]})
    with pytest.raises(UsageError, match="different numbers of rows"):
        count_rows({**bound, "other": np.zeros((2, 2))})


def test_names_of_numbered_files() -> None:
    assert numbered("mesh_{:03d}.ply", 7, 10) == "mesh_007.ply"
    assert numbered("out/mesh.ply", 7, 12) == "out/mesh-07.ply"
    with pytest.raises(UsageError, match="03d"):
        numbered("mesh_{name}.ply", 7, 10)
