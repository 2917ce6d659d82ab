"""Entries of a worker's control array (int64), which the kernels and their caller share."""

from __future__ import annotations

(STACK_BOTTOM, STACK_TOP, TOP_F, TOP_I, STOP, LEAF_CHOICES, NODES, PRUNED, LEAVES, FOLDS, TRIMMED, NEED_F, NEED_I) = (
    range(13)
)
(BROKEN_CUTS, DEEPEST, NEED_CORNERS, NEED_POLYGONS, LARGE_UNITS, ASKED) = range(13, 19)
(TRACKED_LEVELS, TRACKED_UNITS, SHAVED, PROFILE) = range(19, 23)
# Nodes and cycles per power of two of unstable units, then per number of layers that have any.
PROFILE_BINS = 16
CONTROL_SIZE = PROFILE + 4 * PROFILE_BINS
