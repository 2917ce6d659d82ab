"""Analytic level sets, many in degenerate position: the oracle finds what was computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mn_onnx.extract.invariants import check_invariants
from mn_onnx.extract.pipeline import extract_surface
from mn_onnx.extract.weld import weld
from mn_onnx.ir.evaluate import evaluate
from mn_onnx.warmup import warm_up
from oracle.corpus import CORPUS, Case
from oracle.level_set import exact_level_set
from oracle.point_sets import exact_counts, point_set_counts
from oracle.sketch import as_network
from oracle.soups import as_soup


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Kernels compiled by two processes: in a new checkout these tests are the first, and would do it in one."""
    warm_up()


@pytest.mark.parametrize("case", CORPUS, ids=str)
def test_oracle_agrees_with_the_table(case: Case) -> None:
    exact = exact_level_set(as_network(case.body), *case.bounds)
    assert float(exact.inner_volume) == pytest.approx(case.volume, abs=1e-12)
    assert exact.area == pytest.approx(case.area, abs=1e-12)
    assert exact.euler == case.euler
    assert len(exact.components) == case.components
    assert bool(exact.flat_regions) == case.has_flat_regions
    rims = [exact.box_faces(edge) for edge in exact.boundary_edges]
    assert all(rims)
    assert {face for faces in rims for face in faces} == case.open_faces
    if not case.open_faces:
        assert exact.enclosed_volume == (exact.inner_volume if exact.facets else 0)
    if case.counts:
        assert (len(exact.facets), len(exact.vertices), exact.n_edges) == case.counts


@pytest.mark.parametrize("case", CORPUS, ids=str)
def test_welding_the_exact_polygons_gives_the_surface_of_the_table(case: Case) -> None:
    """Welding and measuring apart from the traversal, on degenerate meshes too."""
    exact = exact_level_set(as_network(case.body), *case.bounds)
    surface = weld(as_soup(exact))
    invariants = check_invariants(surface, bounds=np.array(case.bounds).T)
    assert invariants.problems() == []
    assert (invariants.polygons, invariants.vertices, invariants.edges) == (
        len(exact.facets),
        len(exact.vertices),
        exact.n_edges,
    )
    assert invariants.euler == case.euler
    assert len(invariants.components) == case.components
    assert invariants.area == pytest.approx(case.area, abs=1e-12)
    if exact.facets and not case.open_faces:
        assert invariants.volume == pytest.approx(case.volume, abs=1e-12)
    assert invariants.boundary_edges == len(exact.boundary_edges)


@pytest.mark.parametrize("case", [case for case in CORPUS if case.name != "box_filling_cube"], ids=str)
def test_extraction_gives_the_surface_of_the_table(case: Case) -> None:
    network = as_network(case.body)
    extraction = extract_surface(network, *(np.array(corner) for corner in case.bounds))
    surface = extraction.surface
    invariants = check_invariants(surface, bounds=np.array(case.bounds).T)
    assert invariants.problems() == []
    assert invariants.degenerate_polygons == invariants.polygons_with_zero_edges == 0
    assert point_set_counts(surface) == exact_counts(exact_level_set(network, *case.bounds))
    assert invariants.euler == case.euler
    assert len(invariants.components) == case.components
    assert invariants.area == pytest.approx(case.area, abs=1e-12)
    if surface.n_polygons and not case.open_faces:
        assert invariants.volume == pytest.approx(case.volume, abs=1e-12)
    assert set(np.unique(surface.box_faces[surface.boundary])) <= case.open_faces
    assert bool(extraction.flat_regions) == case.has_flat_regions
    assert np.abs(evaluate(network, surface.vertices)).max(initial=0.0) < 1e-14


def test_solid_that_fills_the_box_is_shown() -> None:
    """Its level set in the open box is empty, as the oracle says; a user is better served by the faces of the box."""
    (case,) = (case for case in CORPUS if case.name == "box_filling_cube")
    extraction = extract_surface(as_network(case.body), *(np.array(corner) for corner in case.bounds))
    invariants = check_invariants(extraction.surface, bounds=np.array(case.bounds).T)
    assert invariants.problems() == []
    assert invariants.closed
    assert extraction.degeneracy.box_copies == extraction.surface.n_polygons
    assert (invariants.area, invariants.volume, invariants.euler) == (pytest.approx(24), pytest.approx(8), 2)
