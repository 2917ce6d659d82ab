"""The profile of an extraction: it adds up, and it is printed where it disturbs nobody."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_models import octahedron_model

from mn_onnx.cli import main
from mn_onnx.profile import layer_entries, profile_entries, profile_text


def test_groups_are_powers_of_two_of_units() -> None:
    profile = np.array([[1, 2, 0, 5], [100, 300, 0, 600]])
    assert profile_entries(profile) == [
        {"units": [0, 0], "cells": 1, "share": 0.1, "cycles_per_cell": 100.0},
        {"units": [1, 1], "cells": 2, "share": 0.3, "cycles_per_cell": 150.0},
        {"units": [4, 7], "cells": 5, "share": 0.6, "cycles_per_cell": 120.0},
    ]
    assert profile_entries(None) == layer_entries(None) == []
    assert [group["layers"] for group in layer_entries(profile)] == [0, 1, 3]


def test_profile_goes_to_standard_error_and_into_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, report_file = tmp_path / "model.onnx", tmp_path / "report.json"
    model.write_bytes(octahedron_model().SerializeToString())
    arguments = ["extract", str(model), "-o", str(tmp_path / "mesh.ply"), "--report", str(report_file)]
    assert main([*arguments, "--profile"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(report_file.read_text())
    for groups in (report["traversal"]["profile"], report["traversal"]["layers"]):
        assert sum(group["cells"] for group in groups) == report["nodes"]
        assert sum(group["share"] for group in groups) == pytest.approx(1)
    assert max(group["layers"] for group in report["traversal"]["layers"]) == 1  # the octahedron's three units are one
    assert err == profile_text(report) + "\n"
    for phase in report["seconds"]:
        assert phase in err
    assert "2 to 3" in err  # the octahedron's three units
    assert "cells per polygon" in err
    assert "cycles" not in out
