"""How many pieces the level set of a canonical network has, estimated before it is extracted.

In general position every vertex of the level set lies on two knot planes, and a closed surface has as many polygons as
vertices. Around a point of the surface the planes of unit ``u`` are lines, ``|a_u|`` of them per length, with
``a_u = density_u * (tangential part of grad t_u)``; two such families cross ``|a_u x a_v|`` times per area, and

    polygons = integral over the surface of  sum over u < v of |a_u x a_v|.

In two dimensions the segments of a curve are counted by ``sum |a_u|``. The surface is sampled along lines parallel to
the axes, which meet it in proportion to ``|n_x| + |n_y| + |n_z|`` per area (Crofton).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.ir.levels import contiguous
from mn_onnx.ir.network import Floats, Network

LINES = {1: 1, 2: 96, 3: 144}
STEPS = 96
MOST_POINTS = 300
# Knots are counted within this part of the box around a point: more than the distance of two, less than a feature.
WINDOW = 1.0 / 64


@dataclass(frozen=True)
class Forecast:
    """``pieces``: polygons (segments in two dimensions, roots in one); ``area``: of the surface (or a length).

    Both are estimates, by random points with a fixed seed: about 10 % off for a large surface. ``angle``: in degrees,
    the median one between the gradients of the tables and of the true functions at these points.
    """

    pieces: float
    area: float
    angle: float


def forecast(network: Network, lower: Floats, upper: Floats) -> Forecast:
    """Estimate the level set of canonical ``network`` in the box ``lower``..``upper`` (float64 [input_dim])."""
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    evaluator = Evaluator(network)
    points, cells = _surface_points(evaluator, lower, upper)
    if network.input_dim == 1 or not len(points):
        return Forecast(float(len(points)), float(len(points)), 0.0)
    generator = np.random.default_rng(1)
    chosen = np.arange(len(points))
    if chosen.size > MOST_POINTS:
        chosen = generator.choice(chosen, MOST_POINTS, replace=False)
    normals = _normals(evaluator, points)
    cosines = np.einsum("ij,ij->i", normals, _normals(Evaluator(network, true_functions=True), points))
    angle = float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0))))
    areas = cells / np.maximum(np.abs(normals).sum(axis=1), 0.5)
    densities = _crossing_densities(evaluator, points[chosen], normals[chosen], WINDOW * float((upper - lower).max()))
    share = float(areas.sum() / areas[chosen].sum())
    return Forecast(float((densities * areas[chosen]).sum() * share), float(areas.sum()), angle)


def _normals(evaluator: Evaluator, points: Floats) -> Floats:
    """The unit vectors along the gradients at ``points``, [n, d]; zero where the gradient is."""
    gradients = evaluator.gradients(points)
    lengths = np.sqrt((gradients**2).sum(axis=1))
    return np.asarray(gradients / np.where(lengths > 0, lengths, 1.0)[:, None])


def _surface_points(evaluator: Evaluator, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
    """Points [n, d] where random lines parallel to an axis meet the surface; the cross-section [n] of each line."""
    dimension = lower.size
    generator = np.random.default_rng(0)
    found, cells = [], []
    for axis in range(dimension):
        others = [other for other in range(dimension) if other != axis]
        extent = upper - lower
        side = round(LINES[dimension] ** (1 / max(1, len(others))))
        grid = np.array(list(np.ndindex(*[side] * len(others))), np.float64)
        grid = (grid + generator.random(grid.shape)) / side
        along = np.linspace(0.0, 1.0, STEPS + 1)
        unit = np.empty((len(grid), STEPS + 1, dimension))
        unit[:, :, others] = grid[:, None, :]
        unit[:, :, axis] = along
        values = evaluator.values((lower + unit * extent).reshape(-1, dimension)).reshape(len(grid), STEPS + 1)
        line, step = np.nonzero((values[:, :-1] < 0) != (values[:, 1:] < 0))
        left, right = values[line, step], values[line, step + 1]
        crossing = unit[line, step].copy()
        crossing[:, axis] += left / (left - right) / STEPS
        found.append(lower + crossing * extent)
        cells.append(np.full(len(line), float(np.prod(extent[others])) / len(grid)))
    return np.concatenate(found), np.concatenate(cells)


def _crossing_densities(evaluator: Evaluator, points: Floats, normals: Floats, window: float) -> Floats:
    """``sum |a_u x a_v|`` (3-D) or ``sum |a_u|`` (2-D) at each of ``points``, [n]."""
    families = _line_families(evaluator, points, normals, window)
    if points.shape[1] == 2:
        return np.asarray(np.sqrt((families**2).sum(axis=2)).sum(axis=1))
    densities = np.zeros(len(points))
    for index, (family, normal) in enumerate(zip(families, normals, strict=True)):
        if not normal.any():  # found on a line across a place where f is constant
            continue
        first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        first /= np.sqrt(first @ first)
        x, y = family @ first, family @ np.cross(normal, first)
        densities[index] = 0.5 * np.abs(np.outer(x, y) - np.outer(y, x)).sum()
    return densities


def _line_families(evaluator: Evaluator, points: Floats, normals: Floats, window: float) -> Floats:
    """The vectors ``a_u`` at each point, [n, units, d]: knots within ``window``, per length, across the surface."""
    network = evaluator.network
    n, dimension = points.shape
    variables = np.zeros((n, network.n_variables))
    variables[:, :dimension] = points
    slopes = np.zeros((n, dimension, network.n_variables))
    slopes[:, np.arange(dimension), np.arange(dimension)] = 1.0
    families = np.zeros((n, len(network.units), dimension))
    for block, groups in evaluator.levels:
        t = variables[:, contiguous(block.columns)] @ block.weights.T + block.bias
        of_t = slopes[:, :, contiguous(block.columns)] @ block.weights.T
        for group in groups:
            at = t[:, group.positions]
            variables[:, group.outputs] = group.function.values(at)
            slopes[:, :, group.outputs] = group.function.slopes(at)[:, None, :] * of_t[:, :, group.positions]
        normal_part = np.einsum("nd,ndu->nu", normals, of_t)
        tangential = np.moveaxis(of_t, 1, 2) - normals[:, None, :] * normal_part[:, :, None]
        steepness = np.sqrt((tangential**2).sum(axis=2))
        reach = steepness * window
        for position, index in enumerate(block.units.tolist()):
            table = network.units[index].table
            if table is None:
                raise ValueError(f"{network.units[index].name}: it has no table; run the canonical passes first")
            centre, half = t[:, position], reach[:, position]
            count = np.searchsorted(table.knots, centre + half) - np.searchsorted(table.knots, centre - half)
            families[:, index] = (
                tangential[:, position] * (count / np.where(steepness[:, position] > 0, 2 * half, 1.0))[:, None]
            )
    return families
