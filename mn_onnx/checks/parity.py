"""Whether what was imported is what other programs compute: comparison with onnxruntime at points of the box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray

from mn_onnx.checks.runtime import Runtime
from mn_onnx.ir.evaluate import rounding_error_bounds
from mn_onnx.ir.evaluator import Evaluator
from mn_onnx.layout import PointInput
from mn_onnx.model import Model
from mn_onnx.reader.tensors import model_tensors

Floats = NDArray[np.float64]

UNIFORM_POINTS = 2048
NEAR_SURFACE_POINTS = 1024
"""More would cost time and tell nothing new: an operator that is read wrongly is wrong nearly everywhere."""

BISECTIONS = 16
"""Pairs of points end 2^-16 of their distance apart; float32 still tells such points apart."""

BATCH_SIZES = (1, 2, 7)
"""Besides one large batch: a network whose value at a point depends on the other points differs between them."""

MOST_UNEXPLAINED = 0.05
"""The part of the points at which knots only may explain the difference; a misread operator differs at nearly all."""

LEAST_ALLOWED_SHARE = 0.25
"""What is allowed everywhere, as a share of the median: constants that cancel, as in ``(y + 1) - 1``, become one when a
model is imported, and their rounding stands in no row then."""

UNIT_ROUNDOFF: dict[int, float] = {
    onnx.TensorProto.FLOAT: 2.0**-24,
    onnx.TensorProto.FLOAT16: 2.0**-11,
    onnx.TensorProto.BFLOAT16: 2.0**-8,
}
"""Half the distance from 1 to the next number of each format."""


@dataclass(frozen=True)
class Parity:
    """The outcome of a comparison.

    ``runtime``: the program compared with, ``note``: why it is not onnxruntime (else empty). ``points``: how many were
    compared. ``max_abs_err``: the largest difference. ``allowed_err``: the largest difference that the rounding of the
    program's arithmetic explains at any of the points where no unit is on a knot but for rounding. ``worst_ratio``: the
    largest ratio of a difference to what rounding and knots explain at its own point; above 1 the network was not
    imported rightly. ``unexplained_share``: the part of the points (of a batch of one size, the largest of all) at
    which only knots within the worst case of rounding would explain the difference; such points are rare.
    """

    runtime: str
    note: str
    points: int
    max_abs_err: float
    allowed_err: float
    worst_ratio: float
    unexplained_share: float

    def problems(self) -> list[str]:
        """A sentence if the comparison failed, else nothing."""
        if self.worst_ratio <= 1 and self.unexplained_share <= MOST_UNEXPLAINED:
            return []
        if np.isinf(self.max_abs_err):
            return [
                f"{self.runtime} has values that are infinite or not numbers where the imported network, in float64, "
                "has none: the model's arithmetic overflows in the box (try smaller --bounds), or uses an operator in "
                "a way that is read wrongly"
            ]
        return [
            f"the imported network differs from {self.runtime} by {self.max_abs_err:.3g}, more than rounding explains "
            f"({self.allowed_err:.3g} at most, but at knots): the model uses an operator in a way that is read "
            "wrongly, or its value at a point depends on the other points of a batch"
        ]


def check_parity(model: Model, runtime: Runtime, *, seed: int = 0) -> Parity:
    """Compare the imported network, in float64 and with its true activations, with ``runtime``.

    Points are uniform in the box, at its corners, and near the level set; they are evaluated in one batch, and some of
    them again in the small batches `BATCH_SIZES`. The tolerance at each point is the rounding error bound of the IR, at
    least `LEAST_ALLOWED_SHARE` of its median.

    Raises `CheckFailed` if the runtime stops with an error.
    """
    points = probe_points(model, seed=seed)
    ours = model.evaluate(points)
    theirs = [runtime.evaluate(points)]
    chosen = [np.arange(len(points))]
    start = 0
    for size in BATCH_SIZES:
        part = np.arange(start, start + 3 * size)
        chosen.append(part)
        theirs.append(runtime.evaluate(points[part], batch=size))
        start += 3 * size
    index = np.concatenate(chosen)
    difference = np.abs(np.concatenate(theirs) - ours[index])
    # A result that is not a number agrees with nothing.
    difference[np.isnan(difference)] = np.inf
    unit = coarsest_rounding(model.read.model)
    smooth, anywhere = (
        np.maximum(bound, LEAST_ALLOWED_SHARE * np.median(bound))[index]
        for bound in rounding_error_bounds(model.imported.network, points, unit_roundoff=unit)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0, 0.0, difference / anywhere)
    unexplained = ~(difference <= smooth)
    shares, begin = [], 0
    for batch in chosen:
        # One point of a small batch may be at a knot.
        count = np.count_nonzero(unexplained[begin : begin + len(batch)])
        shares.append(count / len(batch) if count > 1 else 0.0)
        begin += len(batch)
    return Parity(
        runtime.name,
        runtime.note,
        len(index),
        float(difference.max()),
        float(smooth.max()),
        float(ratio.max()),
        max(shares),
    )


def coarsest_rounding(model: onnx.ModelProto) -> float:
    """The unit roundoff of the least precise number format that the model computes with, at least that of float32."""
    types = {stored.tensor.data_type for stored in model_tensors(model)}
    types |= {value.type.tensor_type.elem_type for value in (*model.graph.input, *model.graph.output)}
    types |= {
        attribute.i
        for node in model.graph.node
        if node.op_type == "Cast"
        for attribute in node.attribute
        if attribute.name == "to"
    }
    return max(UNIT_ROUNDOFF.get(data_type, 0.0) for data_type in (*types, onnx.TensorProto.FLOAT))


def probe_points(model: Model, *, seed: int = 0) -> Floats:
    """Points of the box, float64 [n, dimension]: uniform, corners, and pairs bisected onto the level set.

    All are rounded to the number formats of the inputs, so that a runtime is fed the same points.
    """
    generator = np.random.default_rng(seed)
    uniform = generator.uniform(model.lower, model.upper, (UNIFORM_POINTS, model.dimension))
    corners = np.stack(np.meshgrid(*model.bounds, indexing="ij"), axis=-1).reshape(-1, model.dimension)
    evaluator = Evaluator(model.network)
    values = evaluator.values(uniform)
    inside, outside = uniform[values < 0], uniform[values >= 0]
    near = np.empty((0, model.dimension))
    if len(inside) and len(outside):
        near = _bisect(
            evaluator,
            inside[generator.integers(len(inside), size=NEAR_SURFACE_POINTS)],
            outside[generator.integers(len(outside), size=NEAR_SURFACE_POINTS)],
        )
    points = np.concatenate([uniform, near, corners])
    for entry in model.imported.layout.inputs:
        if isinstance(entry, PointInput):
            points = points.astype(entry.dtype).astype(np.float64)
    return points


def _bisect(evaluator: Evaluator, inside: Floats, outside: Floats) -> Floats:
    """Points close to the level set on the segments from ``inside`` (f < 0) to ``outside``, float64 [n, dimension]."""
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        negative = (evaluator.values(middle) < 0)[:, None]
        inside, outside = np.where(negative, middle, inside), np.where(negative, outside, middle)
    return inside
