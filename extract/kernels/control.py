"""Entries of a worker's control array (int64), which the kernels and their caller share."""

from __future__ import annotations

(STACK_BOTTOM, STACK_TOP, TOP_F, TOP_I, STOP, LEAF_CHOICES, NODES, PRUNED, LEAVES, FOLDS, TRIMMED, NEED_F, NEED_I) = (
    range(13)
)
(BROKEN_CUTS, DEEPEST, NEED_CORNERS, NEED_POLYGONS, PROFILE) = range(13, 18)
# Per power of two of unstable units: nodes, cycles.
PROFILE_BINS = 16
CONTROL_SIZE = PROFILE + 2 * PROFILE_BINS
