"""The named corpus of analytic level sets: what must hold for each, computed by hand.

``volume`` is that of ``{f < 0}`` in the box, ``area`` that of the surface inside the open box (a facet in a box face is
not part of it), ``counts`` are polygons, vertices and edges after clean-up where a short argument gives them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from oracle.shapes import (
    affine,
    box,
    cuboctahedron,
    difference,
    even_normals,
    fan,
    fat,
    knots_on_the_box_faces,
    octahedron,
    octahedron_by_relus,
    pillar,
    repeated_relu,
    slab,
    terraces,
    tetrakis_hexahedron,
    union,
    units_without_influence,
)
from oracle.sketch import Body

UNIT_BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
EVERY_FACE = frozenset(range(6))


@dataclass(frozen=True)
class Case:
    """One analytic level set; ``open_faces`` are the box faces (``2 * axis + side``) where the surface has a rim."""

    name: str
    body: Body
    volume: float
    area: float
    euler: int
    components: int = 1
    counts: tuple[int, int, int] | None = None
    open_faces: frozenset[int] = frozenset()
    bounds: tuple[tuple[float, ...], tuple[float, ...]] = UNIT_BOX
    has_flat_regions: bool = False

    def __str__(self) -> str:
        return self.name


def _fan_case(n_normals: int) -> Case:
    normals = np.array(even_normals(n_normals))
    halfspaces = np.concatenate([normals, np.full((n_normals, 1), -0.5)], axis=1)
    hull = ConvexHull(HalfspaceIntersection(halfspaces, np.zeros(3)).intersections)
    return Case(f"fan_of_{n_normals}", fan(normals.tolist(), 0.5), hull.volume, hull.area, 2)


# A face x = +-1/2 or y = +-1/2 of the cube is cut in 4 by the other two coordinate planes, a face z = +-1/2 in 8,
# because the first maximum bends along |x| = |y| too. Vertices: 8 corners, 12 middles of edges, 6 middles of faces.
CUBE_COUNTS = (32, 26, 56)
HOLED_FRAME = difference(box((0.75, 0.75, 0.25)), box((0.375, 0.375, 0.5)))
NOTCHED_CUBE = difference(box((0.5,) * 3), box((0.25,) * 3, (0, 0, 0.5)))
TWO_BOXES = union(box((0.25,) * 3, (-0.5, 0, 0)), box((0.25,) * 3, (0.5, 0, 0)))

CLOSED = (
    Case("cube", box((0.5,) * 3), 1, 6, 2, counts=CUBE_COUNTS),
    Case("octahedron", octahedron(0.5), 1 / 6, sqrt(3), 2, counts=(8, 6, 12)),
    Case("octahedron_by_relus", octahedron_by_relus(0.5), 1 / 6, sqrt(3), 2, counts=(8, 6, 12)),
    Case("octahedron_touching_the_box", octahedron(1), 4 / 3, 4 * sqrt(3), 2, counts=(8, 6, 12)),
    Case("cuboctahedron", cuboctahedron(), 5 / 6, 3 + sqrt(3), 2),
    Case("tetrakis_hexahedron", tetrakis_hexahedron(), 4 / 9, 4 * sqrt(5) / 3, 2, counts=(24, 14, 36)),
    _fan_case(12),
    _fan_case(16),
    Case("two_boxes", TWO_BOXES, 1 / 4, 3, 4, components=2),
    Case("notched_cube", NOTCHED_CUBE, 15 / 16, 6.5, 2),
    Case("holed_frame", HOLED_FRAME, 27 / 32, 63 / 8, 0),
    Case("shell", difference(box((0.75,) * 3), box((0.25,) * 3)), 13 / 4, 15, 4, components=2),
    Case(
        "off_centre",
        box((0.5, 1, 0.125), (1, -2, 0)),
        1 / 2,
        5.5,
        2,
        counts=(32, 30, 60),  # on the faces of z, |x| - 1/2 = |y| - 1 ends on x = 0, not in the middle
        bounds=((0, -4, -1), (3, 1, 1)),
    ),
)

OPEN = (
    Case("pillar", pillar(0.5), 2, 8, 0, open_faces=frozenset({4, 5})),
    Case(
        "plane", affine((1, 0.5, 0.25), -0.125), 4.5, sqrt(21), 1, counts=(1, 4, 4), open_faces=frozenset({2, 3, 4, 5})
    ),
    Case("plane_through_box_edges", affine((1, -1, 0), 0), 4, 4 * sqrt(2), 1, counts=(1, 4, 4), open_faces=EVERY_FACE),
    Case("hexagon", affine((1, 1, 1), 0), 4, 3 * sqrt(3), 1, counts=(1, 6, 6), open_faces=EVERY_FACE),
    Case(
        "units_without_influence",
        units_without_influence(),
        4.5,
        sqrt(21),
        1,
        counts=(1, 4, 4),
        open_faces=frozenset({2, 3, 4, 5}),
    ),
    Case(
        "knots_on_the_box_faces",
        knots_on_the_box_faces(),
        9 / 4,
        3 * sqrt(2),
        1,
        counts=(1, 4, 4),
        open_faces=frozenset({0, 2, 3, 4}),
    ),
    Case("terraces", terraces(), 4, 3 + sqrt(2), 1, counts=(5, 12, 16), open_faces=frozenset({0, 1, 2, 3})),
    Case(
        "repeated_relu",
        repeated_relu(),
        4,
        2 + 2 * sqrt(2),
        1,
        counts=(2, 6, 7),
        open_faces=frozenset({0, 1, 2, 3}),
    ),
    Case(
        "slab",
        slab(),
        3,
        4,
        1,
        counts=(1, 4, 4),
        open_faces=frozenset({2, 3, 4, 5}),
        has_flat_regions=True,
    ),
)

EMPTY = (
    Case("empty", box((-0.25,) * 3), 0, 0, 0, components=0, counts=(0, 0, 0)),
    Case("negative_everywhere", affine((0.25, 0, 0), -1), 8, 0, 0, components=0, counts=(0, 0, 0)),
    Case("touching_kink", octahedron(0), 0, 0, 0, components=0, counts=(0, 0, 0)),
    Case("box_filling_cube", box((1,) * 3), 8, 0, 0, components=0, counts=(0, 0, 0)),
    Case("fat_cube", fat(box((0.5,) * 3)), 0, 0, 0, components=0, counts=(0, 0, 0), has_flat_regions=True),
)
CORPUS = CLOSED + OPEN + EMPTY
