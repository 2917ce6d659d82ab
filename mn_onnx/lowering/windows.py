"""Sliding windows of convolutions and pools, as index arithmetic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mn_onnx.lowering.node import Node, UnsupportedNode
from mn_onnx.symbolic import Constant, Tensor, check_size, concatenate, lift


@dataclass(frozen=True, eq=False)
class Windows:
    """The windows over the spatial axes.

    ``places``: how many windows there are along each axis. ``index``: int64 [places, window], flat positions in the
    spatial axes, -1 in the padding. ``in_padded``: bool of the same shape, true where a position lies in the input or
    in its explicit padding (a window can reach beyond it in ceil mode).
    """

    places: tuple[int, ...]
    index: NDArray[np.int64]
    in_padded: NDArray[np.bool_]

    @classmethod
    def of_node(cls, node: Node, spatial: Sequence[int], kernel: tuple[int, ...]) -> Windows:
        """Windows by the attributes strides, pads, dilations, auto_pad and ceil_mode."""
        rank = len(spatial)
        if len(kernel) != rank:
            raise UnsupportedNode(f"kernel {list(kernel)} does not fit {rank} spatial axes")
        strides = node.attribute("strides") or [1] * rank
        dilations = node.attribute("dilations") or [1] * rank
        pads = node.attribute("pads") or [0] * (2 * rank)
        auto_pad = node.attribute("auto_pad", "NOTSET")
        axes = []
        for axis in range(rank):
            reach = dilations[axis] * (kernel[axis] - 1) + 1
            before, after = pads[axis], pads[rank + axis]
            if auto_pad in ("SAME_UPPER", "SAME_LOWER"):
                total = max((math.ceil(spatial[axis] / strides[axis]) - 1) * strides[axis] + reach - spatial[axis], 0)
                before = total // 2 if auto_pad == "SAME_UPPER" else total - total // 2
                after = total - before
            elif auto_pad == "VALID":
                before = after = 0
            free = spatial[axis] + before + after - reach
            steps = math.ceil(free / strides[axis]) if node.attribute("ceil_mode", 0) else free // strides[axis]
            if steps < 0:
                raise UnsupportedNode(f"its window {list(kernel)} is larger than the input {list(spatial)}")
            starts = np.arange(steps + 1) * strides[axis] - before
            # A last window of ceil mode that would start in the padding behind the input is dropped.
            starts = starts[starts < spatial[axis] + (after if steps == free // strides[axis] else 0)]
            axes.append((starts[:, None] + dilations[axis] * np.arange(kernel[axis]), spatial[axis] + after))
        return cls._join(axes, spatial)

    @classmethod
    def _join(cls, axes: list[tuple[NDArray[np.int64], int]], spatial: Sequence[int]) -> Windows:
        places = tuple(positions.shape[0] for positions, _ in axes)
        sizes = [positions.shape[1] for positions, _ in axes]
        check_size((*places, *sizes))
        index = np.zeros((*places, *sizes), np.int64)
        inside, padded = np.ones(index.shape, np.bool_), np.ones(index.shape, np.bool_)
        rank = len(axes)
        for axis, (positions, end) in enumerate(axes):
            shape = [1] * (2 * rank)
            shape[axis], shape[rank + axis] = positions.shape
            spread = positions.reshape(shape)
            index = index * spatial[axis] + spread
            inside &= (spread >= 0) & (spread < spatial[axis])
            padded &= spread < end
        flat = (math.prod(places), math.prod(sizes))
        return cls(places, np.where(inside, index, -1).reshape(flat), padded.reshape(flat))


def gather_windows(x: Tensor, windows: Windows, padding: float) -> Tensor:
    """Elements [n, channels, places, window] of ``x`` [n, channels, spatial...]; ``padding`` fills the outside."""
    n, channels = x.shape[:2]
    spatial = math.prod(x.shape[2:])
    extended = lift(concatenate([x.reshape(-1), Constant.of(np.full(1, padding))], 0))
    start = (np.arange(n * channels) * spatial).reshape(n, channels, 1, 1)
    check_size((n, channels, *windows.index.shape))
    return extended.take(np.where(windows.index >= 0, start + windows.index, x.size)).with_dtype(x.dtype)
