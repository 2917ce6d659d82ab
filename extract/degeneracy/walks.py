"""Polygons as cyclic walks of half-edges that can be edited: how polygons without area leave a closed mesh.

A polygon loses its area when vertices coincide or come to lie on one line. Its outline then runs forth and back along a
line, and the polygons on both sides of it become neighbours: where the outline turns, its last two half-edges are the
same edge in both directions and cancel; where the way back has a corner that the way forth has not, the polygon across
gets that corner first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mn_onnx.extract.blocks import Indices

Floats = NDArray[np.float64]


class Walks:
    """Half-edges ``h`` from vertex ``tails[h]``, linked both ways within their polygon and to their twins (-1: none).

    ``following[h]`` is -1 for a half-edge that has been removed. The first half-edges are the corners of the mesh the
    walks were made from; inserted corners come after them.
    """

    def __init__(
        self,
        tails: Indices,
        following: Indices,
        preceding: Indices,
        twins: Indices,
        polygons: Indices,
        box_faces: NDArray[np.int8],
    ) -> None:
        self.tails: list[int] = tails.tolist()
        self.following: list[int] = following.tolist()
        self.preceding: list[int] = preceding.tolist()
        self.twins: list[int] = twins.tolist()
        self.polygons: list[int] = polygons.tolist()
        self.box_faces: list[int] = box_faces.tolist()

    def outline(self, start: int) -> list[int]:
        """The half-edges of a polygon from ``start`` on; empty if ``start`` has been removed."""
        found: list[int] = []
        half_edge = start
        while self.following[half_edge] >= 0 and not (found and half_edge == start):
            found.append(half_edge)
            half_edge = self.following[half_edge]
        return found

    def flatten(self, start: int, positions: Floats) -> None:
        """Remove the polygon of ``start``, whose corners lie on one line, as far as it does not border on itself.

        ``positions``: float64 [v, 3], of all vertices.
        """
        outline = self.outline(start)
        while outline:
            places = positions[[self.tails[half_edge] for half_edge in outline]]
            along = places[np.argmax(((places - places[0]) ** 2).sum(axis=1))] - places[0]
            reach = (places - places[0]) @ along
            # The half-edge that arrives at the far end of the line, and the one that leaves it.
            leaving = outline[int(np.argmax(reach))]
            arriving = self.preceding[leaving]
            before, after = self.tails[arriving], self.tails[self.following[leaving]]
            if before != after:
                place = dict(zip((self.tails[half_edge] for half_edge in outline), reach, strict=True))
                half_edge, vertex = (arriving, after) if place[before] < place[after] else (leaving, before)
                twin = self.twins[half_edge]
                if twin >= 0 and self.polygons[twin] == self.polygons[half_edge]:
                    return
                inserted = self._insert(half_edge, vertex)
                if half_edge == arriving:
                    arriving = inserted
            start = self._cancel(arriving)
            outline = self.outline(start) if start >= 0 else []

    def _insert(self, half_edge: int, vertex: int) -> int:
        """Divide an edge at ``vertex``, on both sides of it; returns the half-edge from ``vertex`` on."""
        twin = self.twins[half_edge]
        rest = self._insert_after(half_edge, vertex)
        if twin >= 0:
            rest_of_twin = self._insert_after(twin, vertex)
            self._join(half_edge, rest_of_twin)
            self._join(rest, twin)
        return rest

    def _insert_after(self, half_edge: int, vertex: int) -> int:
        new, after = len(self.tails), self.following[half_edge]
        self.tails.append(vertex)
        self.following.append(after)
        self.preceding.append(half_edge)
        self.twins.append(-1)
        self.polygons.append(self.polygons[half_edge])
        self.box_faces.append(self.box_faces[half_edge])
        self.following[half_edge] = new
        self.preceding[after] = new
        return new

    def _cancel(self, arriving: int) -> int:
        """Remove a half-edge and its successor, the way back, from their polygon and join the polygons across them.

        Returns a half-edge that the polygon still has, -1 if there is none.
        """
        leaving = self.following[arriving]
        one, other = self.twins[arriving], self.twins[leaving]
        if one != leaving:
            if one >= 0 and other >= 0:
                self._join(one, other)
            elif one >= 0:
                self.twins[one], self.box_faces[one] = -1, self.box_faces[leaving]
            elif other >= 0:
                self.twins[other], self.box_faces[other] = -1, self.box_faces[arriving]
        before, after = self.preceding[arriving], self.following[leaving]
        self.following[arriving] = self.following[leaving] = -1
        if before == leaving:
            return -1
        self.following[before] = after
        self.preceding[after] = before
        return before

    def _join(self, one: int, other: int) -> None:
        self.twins[one], self.twins[other] = other, one
        self.box_faces[one] = self.box_faces[other] = -1
