"""Bodies for `oracle.sketch` of solids whose level sets can be computed by hand, most in degenerate position."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from oracle.sketch import Body, Sketch


def affine(normal: Sequence[float], offset: float) -> Body:
    """``normal . x + offset``."""
    return lambda sketch, x: sketch.affine(x, [normal], [offset])


def box(half: Sequence[float], centre: Sequence[float] = (0, 0, 0)) -> Body:
    """``max_i |x_i - centre_i| - half_i``: negative inside the box."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        sides = sketch.abs(sketch.affine(x, np.eye(3), -np.asarray(centre, float)))
        return _maximum(sketch, sketch.affine(sides, np.eye(3), -np.asarray(half, float)), 3)

    return body


def pillar(half: float) -> Body:
    """``max(|x|, |y|) - half``."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        sides = sketch.abs(sketch.affine(x, np.eye(3)[:2], [0, 0]))
        return _maximum(sketch, sketch.affine(sides, np.eye(2), [-half] * 2), 2)

    return body


def octahedron(radius: float) -> Body:
    """``|x| + |y| + |z| - radius``."""
    return lambda sketch, x: sketch.affine(sketch.abs(x), [[1, 1, 1]], [-radius])


def octahedron_by_relus(radius: float) -> Body:
    """The octahedron with ``|x| = relu(x) + relu(-x)``: every plane is the knot of two opposite units."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        signs = sketch.relu(sketch.affine(x, np.concatenate([np.eye(3), -np.eye(3)]), np.zeros(6)))
        return sketch.affine(signs, np.ones((1, 6)), [-radius])

    return body


def cuboctahedron() -> Body:
    """``max(|x|, |y|, |z|) <= 1/2`` and ``|x| + |y| + |z| <= 1``."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        sides = sketch.abs(x)
        cube = _maximum(sketch, sketch.affine(sides, np.eye(3), [-0.5] * 3), 3)
        return sketch.maximum(cube, sketch.affine(sides, [[1, 1, 1]], [-1]))

    return body


def tetrakis_hexahedron() -> Body:
    """``sum |x_i + x_j| + |x_i - x_j| - 2``: six planes through the origin, six facets at some vertices."""
    normals = [[1, 1, 0], [1, -1, 0], [0, 1, 1], [0, 1, -1], [1, 0, 1], [1, 0, -1]]
    return lambda sketch, x: sketch.affine(sketch.abs(sketch.affine(x, normals, np.zeros(6))), np.ones((1, 6)), [-2])


def fan(normals: Sequence[Sequence[float]], offset: float) -> Body:
    """``max_i normals_i . x - offset``, as a balanced tree of maxima."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        features, n_features = sketch.affine(x, normals, [-offset] * len(normals)), len(normals)
        while n_features > 1:
            identity, half = np.eye(n_features), (n_features + 1) // 2
            first = sketch.affine(features, identity[:half], np.zeros(half))
            last = sketch.affine(features, identity[n_features - half :], np.zeros(half))
            features, n_features = sketch.maximum(first, last), half
        return features

    return body


def union(first: Body, second: Body) -> Body:
    return lambda sketch, x: sketch.minimum(first(sketch, x), second(sketch, x))


def difference(first: Body, second: Body) -> Body:
    return lambda sketch, x: sketch.maximum(first(sketch, x), sketch.affine(second(sketch, x), [[-1]], [0]))


def terraces() -> Body:
    """``z - clip(x, -1/2, -1/4) - clip(x, 1/4, 1/2)``: four parallel knot planes, two in each of two tables."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        along = sketch.affine(x, [[1, 0, 0]], [0])
        height = sketch.affine(x, [[0, 0, 1]], [0])
        steps = sketch.concat(sketch.clip(along, -0.5, -0.25), sketch.clip(along, 0.25, 0.5))
        return sketch.affine(sketch.concat(height, steps), [[1, -1, -1]], [0])

    return body


def repeated_relu() -> Body:
    """``relu(relu(x)) + z - 1/4``: the second unit sits on its knot over half of the space."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        ramp = sketch.relu(sketch.relu(sketch.affine(x, [[1, 0, 0]], [0])))
        return sketch.affine(sketch.concat(ramp, x), [[1, 0, 0, 1]], [-0.25])

    return body


def knots_on_the_box_faces() -> Body:
    """``relu(x + 1) + relu(y - 1) + |z + 1| - 3/2``: inside [-1, 1]^3 this is ``x + z + 1/2``."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        ramps = sketch.relu(sketch.affine(x, [[1, 0, 0], [0, 1, 0]], [1, -1]))
        height = sketch.abs(sketch.affine(x, [[0, 0, 1]], [1]))
        return sketch.affine(sketch.concat(ramps, height), [[1, 1, 1]], [-1.5])

    return body


def units_without_influence() -> Body:
    """A plane, and units that are never or always active in the box."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        idle = sketch.relu(sketch.affine(x, [[1, 0, 0], [0, 1, 0]], [-5, 5]))
        return sketch.affine(sketch.concat(x, idle), [[1, -0.5, 0.25, 1, 1]], [-5.125])

    return body


def fat(body: Body) -> Body:
    """``relu(body)``: zero in the whole solid, negative nowhere."""
    return lambda sketch, x: sketch.relu(body(sketch, x))


def slab() -> Body:
    """``relu(x - 1/4) - relu(-x - 1/4)``: zero for ``|x| <= 1/4``, with a change of sign across the slab."""

    def body(sketch: Sketch[Any], x: Any) -> Any:
        sides = sketch.relu(sketch.affine(x, [[1, 0, 0], [-1, 0, 0]], [-0.25, -0.25]))
        return sketch.affine(sides, [[1, -1]], [0])

    return body


def even_normals(n_normals: int) -> list[list[float]]:
    """Unit vectors spread over the sphere on a Fibonacci spiral, rounded to multiples of 2^-10."""
    heights = 1 - (2 * np.arange(n_normals) + 1) / n_normals
    angles = np.pi * (1 + np.sqrt(5)) * np.arange(n_normals)
    radii = np.sqrt(1 - heights**2)
    normals = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
    return (np.round(normals * 1024) / 1024).tolist()


def _maximum(sketch: Sketch[Any], features: Any, n_features: int) -> Any:
    rows = (sketch.affine(features, [row], [0]) for row in np.eye(n_features))
    return reduce(sketch.maximum, rows)
