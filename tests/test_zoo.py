"""Files of real exporters: exact, with surrogates, or refused, as their manifest says, and with the right values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mn_onnx.errors import ModelRefused
from mn_onnx.model import Model, load

FOLDER = Path(__file__).parent / "data" / "zoo"
ENTRIES: list[dict[str, Any]] = json.loads((FOLDER / "manifest.json").read_text())
# The probes were computed with the precision of the file's own arithmetic.
TOLERANCE = {"fmt-float16-dy18": 2e-3, "fmt-bfloat16-dy18": 2e-2}


def bindings(entry: dict[str, Any]) -> dict[str, Any]:
    """What a user must bind: extra inputs, and columns of the points."""
    bind: dict[str, Any] = {}
    for value in entry.get("inputs", []):
        if value["role"] == "bound":
            bind[value["name"]] = np.asarray(value["value"])
        elif value.get("bound"):
            width = value["shape"][value["coord_axis"]]
            rest = [str(column) for column in range(width) if column not in value["coords"]]
            bind[f"{value['name']}[{','.join(rest)}]"] = value["bound"]
    return bind


def loaded(entry: dict[str, Any], *, with_output: bool) -> Model | None:
    """The model, or None if it is refused with reasons."""
    output = entry.get("output") if with_output else None
    if output is not None:
        output = output["name"] if output["channel"] is None else f"{output['name']}:{output['channel']}"
    try:
        return load(FOLDER / entry["file"], bind=bindings(entry), output=output, level=entry.get("level", 0.0))
    except ModelRefused:
        return None


def outcome(model: Model | None) -> str:
    return "reject" if model is None else "exact" if model.exact else "surrogate"


def named(*outcomes: str) -> list[Any]:
    return [pytest.param(entry, id=entry["name"]) for entry in ENTRIES if entry["expect"] in outcomes]


@pytest.mark.parametrize("entry", named("reject"))
def test_refused_files(entry: dict[str, Any]) -> None:
    model = loaded(entry, with_output=False)
    assert outcome(model) in ("reject", *entry.get("also_ok", []))
    if model is None:
        with pytest.raises(ModelRefused) as refused:
            load(FOLDER / entry["file"], bind=bindings(entry))
        assert refused.value.problems
        assert all(problem.reason and problem.remedy for problem in refused.value.problems)


@pytest.mark.parametrize("entry", named("exact", "surrogate"))
def test_accepted_files(entry: dict[str, Any]) -> None:
    model = loaded(entry, with_output=True)
    assert outcome(model) in (entry["expect"], *entry.get("also_ok", []))
    if model is None:
        return
    assert model.dimension == entry["dim"]
    expected = np.asarray(entry["probe"]["values"])
    actual = model.evaluate(np.asarray(entry["probe"]["points"]))
    tolerance = TOLERANCE.get(entry["name"], 3e-5) * np.abs(expected).max()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


def test_every_kind_of_file_is_there() -> None:
    """A lost manifest entry would pass silently."""
    kinds = {(entry["category"], entry["expect"]) for entry in ENTRIES}
    assert {"exact", "surrogate", "reject"} <= {expect for _, expect in kinds}
    assert {"pl", "deepsdf", "igr", "smooth", "graph", "dim", "format", "bad"} <= {category for category, _ in kinds}
    assert len(ENTRIES) >= 100
    assert all((FOLDER / entry["file"]).is_file() for entry in ENTRIES)
