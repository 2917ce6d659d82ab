"""What is proved of the mesh of a smooth network, and moving it onto the true level set."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from mn_onnx.extract.sampling import sample_surface
from mn_onnx.extract.smooth.face_errors import surface_errors
from mn_onnx.extract.smooth.polish import polish
from mn_onnx.extract.surface import Surface
from mn_onnx.ir.evaluate import gradient
from mn_onnx.ir.network import Network
from mn_onnx.ir.passes import Canonical

SHALLOW = 0.1
"""Below this part of the median slope, what an error means for the place of the surface is not foretold."""

VAGUE = 0.05
"""A displacement bound above this part of the largest side of the box says nothing of where the surface is."""

PLACED = 1e-9
"""Vertices are on the level set of the surrogates up to much less than this part of the box: rounding, and what
coincides becomes one."""

ANGLE_SAMPLES = 1 << 14

CLOSE_ENOUGH = 1.2
"""Of the mean |f| that polishing is to reach on faces: what a sample may say by chance."""

NOT_CERTIFIED: Mapping[str, None] = dict.fromkeys(
    (
        "surface_eps",
        "surface_eps_median",
        "displacement",
        "displacement_median",
        "shallow_polygons",
        "vague_polygons",
        "gradient_angle_median",
        "turned_share",
    )
)
"""The entries of `certified` where there is nothing to prove."""


def certified(surface: Surface, canonical: Canonical, *, threads: int | None = None) -> tuple[Surface, dict[str, Any]]:
    """The surface of a smooth network with the proved error of each polygon, and what the report says of them.

    ``attributes["eps"]`` are these errors, ``attributes["displacement"]`` how far the true level set may be from each
    polygon: eps over the slope there, to first order in eps. Where the slope is small this says little.
    """
    surface, entries = _with_errors(surface, canonical, canonical.surrogate_eps, threads)
    return surface, entries | _gradient_angles(surface, canonical.network)


def _with_errors(
    surface: Surface, canonical: Canonical, most: float, threads: int | None
) -> tuple[Surface, dict[str, Any]]:
    """The surface with the proved errors of its polygons, of which ``most`` is another bound, and what they come to."""
    side = float((canonical.upper - canonical.lower).max())
    errors = surface_errors(canonical.network, surface, canonical.lower, canonical.upper, threads=threads)
    slopes = np.sqrt((surface.gradients**2).sum(axis=1))
    errors = np.minimum(errors, most + PLACED * side * slopes)
    steep = slopes > SHALLOW * np.median(slopes)
    with np.errstate(over="ignore"):  # infinite on a flat polygon
        displacement = errors / np.maximum(slopes, np.finfo(np.float64).tiny)
    attributes = {**surface.attributes, "eps": errors, "displacement": displacement}
    return replace(surface, errors=errors, attributes=attributes), {
        "surface_eps": float(errors.max()),
        "surface_eps_median": float(np.median(errors)),
        "displacement": float(displacement[steep].max(initial=0.0)),
        "displacement_median": float(np.median(displacement)),
        "shallow_polygons": int(np.count_nonzero(~steep)),
        "vague_polygons": int(np.count_nonzero(displacement > VAGUE * side)),
    }


def _gradient_angles(surface: Surface, network: Network) -> dict[str, float]:
    """How far the gradients of the surrogates are from the true ones, at random points of the faces."""
    points, polygons = sample_surface(surface, ANGLE_SAMPLES)
    true, found = gradient(network, points, true_functions=True), surface.gradients[polygons]
    lengths = np.sqrt((true**2).sum(axis=1) * (found**2).sum(axis=1))
    # Without a gradient nothing is known: such places count as turned.
    cosines = np.nan_to_num(np.einsum("ij,ij->i", true, found) / np.where(lengths > 0, lengths, 1.0))
    return {
        "gradient_angle_median": float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))),
        "turned_share": float((cosines <= 0).mean()),
    }


def topology_notes(certificate: Mapping[str, Any]) -> list[str]:
    """What is to be said of the topology of a smooth network's mesh, a sentence or none."""
    share = certificate["turned_share"]
    if not share:
        return []
    return [
        f"on about {share:.2g} of the area the gradient of the surrogates is more than 90 degrees from that of the "
        "network: there the topology may be that of the surrogates only, with handles and pieces the network does not "
        "have; take finer surrogates, by a larger --budget or --knots-per-period"
    ]


def polished(
    surface: Surface, canonical: Canonical, *, threads: int | None = None, most_polygons: float = math.inf
) -> tuple[Surface, dict[str, Any]]:
    """The surface, one of `certified`, moved onto the level set of the true network, and what that did.

    Faces are divided for it until they are about ``most_polygons``. Their errors are proved anew.
    """
    moved, result = polish(
        surface,
        canonical.network,
        canonical.lower,
        canonical.upper,
        threads=threads,
        most_polygons=most_polygons,
    )
    moved, entries = _with_errors(moved, canonical, math.inf, threads)
    return moved, asdict(result) | entries


def polish_notes(polish: Mapping[str, Any]) -> list[str]:
    """What is to be said of a polished mesh, a sentence or none; ``polish`` as in the report."""
    found, wanted = polish["true_mean_abs_f"], polish["wanted_mean_abs_f"]
    if found <= CLOSE_ENOUGH * wanted:
        return []
    return [
        f"the mean |f_true| on the faces is {found:.2g}, not {wanted:.2g} as it was to be: closer faces would take too "
        "many polygons or too much memory (--max-memory), or vertices did not reach the level set"
    ]
