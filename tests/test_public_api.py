"""What `import mn_onnx` gives, and that it stays light; what is packaged."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from small_models import octahedron_model, octahedron_volume

import mn_onnx
from mn_onnx.progress import ProgressEvent

ROOT = Path(__file__).resolve().parent.parent


def test_every_public_name_is_there() -> None:
    for name in mn_onnx.__all__:
        assert getattr(mn_onnx, name) is not None
    with pytest.raises(AttributeError, match="nothing_such"):
        _ = mn_onnx.nothing_such


def test_every_public_error_has_one_base() -> None:
    public = (getattr(mn_onnx, name) for name in mn_onnx.__all__)
    errors = [value for value in public if isinstance(value, type) and issubclass(value, Exception)]
    assert len(errors) > 4
    assert all(issubclass(error, mn_onnx.MnOnnxError) for error in errors)


def test_importing_loads_no_heavy_package() -> None:
    code = (
        "import sys, mn_onnx, mn_onnx.cli; heavy = {'numpy', 'numba', 'onnx', 'onnxruntime', 'trimesh', 'rich'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_extract_is_function_and_package() -> None:
    code = (
        "import mn_onnx.extract.surface, mn_onnx.extract.weld as weld, mn_onnx; from mn_onnx import extract;"
        "print(callable(mn_onnx.extract), extract is mn_onnx.extract, weld.__name__)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["True", "True", "mn_onnx.extract.weld"]


def test_extracts_an_octahedron_with_a_full_report() -> None:
    phases: list[str] = []

    def listen(event: ProgressEvent) -> None:
        phases.append(event.phase)

    surface = mn_onnx.extract(octahedron_model(), bounds=(-1, 1), progress=listen)
    report = surface.report
    assert surface.volume == pytest.approx(octahedron_volume(), rel=1e-7)
    assert report["euler"] == 2
    assert report["components"] == 1
    assert report["closed"]
    assert report["exact"]
    assert report["surrogate_eps"] == 0
    assert report["unmatched_edges"] == report["boundary_edges"] == 0
    assert report["max_abs_f"] <= report["allowed_abs_f"] < 1e-13
    assert report["ort_mean_abs_f"] < 1e-6
    assert report["parity_max_abs_err"] <= report["parity_allowed_err"] < 1e-5
    assert report["nodes"] > 0
    assert len(report["model_sha256"]) == 64
    assert {"import", "lower", "compile", "traverse", "weld", "check"} <= report["seconds"].keys()
    assert "numba" in report["versions"]
    assert report["problems"] == []
    order = list(dict.fromkeys(phases))
    assert order == ["import", "check", "compile", "traverse", "weld", "flat"]


def test_loading_apart_from_extracting() -> None:
    model = mn_onnx.load(octahedron_model(), bounds=[(-1, 1), (-1, 1), (-1, 0)])
    assert model.dimension == 3
    assert model.exact
    np.testing.assert_array_equal(model.upper, [1, 1, 0])
    np.testing.assert_allclose(model.evaluate(np.zeros((1, 3))), [-0.5 / 3])
    low, high = model.output_range
    assert low <= -0.5 / 3 < 0.4 < high
    surface = mn_onnx.extract(model, threads=1)
    assert surface.report["boundary_edges"] > 0
    assert surface.report["closed"]
    with pytest.raises(mn_onnx.UsageError, match="loaded already"):
        mn_onnx.extract(model, level=0.1)


def test_an_empty_level_set_is_told_with_range_and_nearest_level() -> None:
    surface = mn_onnx.extract(octahedron_model(), level=-0.25)
    assert surface.n_polygons == 0
    (note,) = surface.report["notes"]
    assert "empty" in note
    assert "-0.16" in note


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"bounds": (1, -1)}, "LOW < HIGH"),
        ({"bounds": (0, 1, 2)}, "3 coordinates"),
        ({"bounds": (0, np.inf)}, "finite"),
        ({"bounds": "wide"}, "not numbers"),
        ({"level": np.nan}, "level"),
        ({"threads": 0}, "threads"),
        ({"output": "z"}, "'y'"),
        ({"bind": {"code": 1.0}}, "code"),
        ({"knots_per_period": 0}, "knots_per_period"),
        ({"surrogate_tol": -1.0}, "surrogate_tol"),
    ],
)
def test_wrong_options_are_usage_errors(options: dict[str, object], words: str) -> None:
    with pytest.raises(mn_onnx.UsageError, match=words):
        mn_onnx.extract(octahedron_model(), **options)


def test_a_network_that_was_read_wrongly_fails_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    from mn_onnx.model import Model

    true = Model.evaluate
    monkeypatch.setattr(Model, "evaluate", lambda self, points: true(self, points) * (1 + 1e-4))
    with pytest.raises(mn_onnx.CheckFailed, match="more than rounding explains"):
        mn_onnx.extract(octahedron_model())


def test_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == mn_onnx.__version__
    assert f"## {mn_onnx.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_every_package_is_packaged() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = set()
    for package, folder in setuptools["package-dir"].items():
        for init in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join([package, *init.parent.relative_to(ROOT / folder).parts]))
    assert set(setuptools["packages"]) == found
