"""Draw the README's picture: marching cubes beside the exact mesh of the same network.

pip install ".[bench]"
python models/picture.py models/bunny_relu_d3_w128.onnx models/bunny.png
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray
from skimage.measure import marching_cubes

import mn_onnx

Floats = NDArray[np.float64]

RESOLUTION = 64
# Orthographic view: right, up and towards the eye, as rows.
VIEW = np.array([[0.94, 0.0, 0.34], [-0.1, 0.96, 0.27], [-0.33, -0.29, 0.9]])
LIGHT = np.array([-0.35, 0.6, 0.72])
WHOLE = (-0.99, 1.07, -1.01, 1.05)
DETAIL = (-0.33, 0.05, 0.47, 0.85)


def cubes(model: mn_onnx.Model) -> tuple[list[Floats], Floats]:
    """Triangles and unit normals of marching cubes on a grid of RESOLUTION^3 points."""
    axes = [np.linspace(low, high, RESOLUTION) for low, high in zip(model.lower, model.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = model.evaluate(grid.reshape(-1, 3)).reshape(grid.shape[:3]) - model.level
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=tuple((model.upper - model.lower) / (RESOLUTION - 1)))
    corners = vertices[faces[:, ::-1]] + model.lower
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.sign(np.einsum("ij,ij->", corners[:, 0], normals))
    normals *= outward / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return list(corners), normals


def polygons(surface: mn_onnx.Surface) -> tuple[list[Floats], Floats]:
    """Polygons and unit normals of an extracted surface."""
    points = surface.vertices[surface.corners]
    return np.split(points, surface.offsets[1:-1]), surface.normals


def draw(
    axes: Axes, shape: tuple[list[Floats], Floats], window: Sequence[float], line_width: float, title: str
) -> None:
    """Paint the faces that look at the viewer, the farthest first, as flat shaded polygons."""
    faces, normals = shape
    seen = [(face @ VIEW.T, normal) for face, normal in zip(faces, normals, strict=True) if normal @ VIEW[2] > 0]
    left, right, bottom, top = window
    inside = [
        (face, normal)
        for face, normal in seen
        if face[:, 0].max() > left and face[:, 0].min() < right and face[:, 1].max() > bottom and face[:, 1].min() < top
    ]
    inside.sort(key=lambda item: float(item[0][:, 2].mean()))
    brightness = np.clip([0.25 + 0.7 * max(0.0, float(normal @ LIGHT)) for _, normal in inside], 0, 1)
    colours = mpl.colormaps["bone"](brightness)
    edges = "#20304080" if line_width else "face"
    collection = PolyCollection(
        [face[:, :2] for face, _ in inside], facecolors=colours, edgecolors=edges, linewidths=line_width or 0.2
    )
    axes.add_collection(collection)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, fontsize=11)


def main() -> None:
    """Extract, sample and draw."""
    if len(sys.argv) != 3:
        sys.exit("usage: python models/picture.py MODEL.onnx PICTURE.png")
    model = mn_onnx.load(sys.argv[1])
    sampled = cubes(model)
    exact = polygons(mn_onnx.extract(model))
    figure, axes = plt.subplots(1, 4, figsize=(16, 4.4), layout="constrained")
    draw(axes[0], sampled, WHOLE, 0.0, f"marching cubes, {RESOLUTION}³: {len(sampled[0]):,} triangles")
    draw(axes[1], sampled, DETAIL, 0.4, "detail")
    draw(axes[2], exact, WHOLE, 0.0, f"mn-onnx, exact: {len(exact[0]):,} polygons")
    draw(axes[3], exact, DETAIL, 0.4, "detail")
    figure.savefig(sys.argv[2], dpi=80)


if __name__ == "__main__":
    main()
