"""The links of the families of a tree: each consists of the children of one node."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from ...support.jit_types import f4, i4


@kernel(i4[:], f4[:])
def find_limits(parent, size):
    """Depths and limits of the nodes that have children.

    Args:
        parent: (F,) int32 place here of the parent of each of these nodes, which comes before it; -1 for the root.
        size: (F,) float32 of each node, any unit.

    Returns:
        depth: (F,) int32 edges from the root.
        limit: (F,) float32 the least size from the root to the node, its own included.
    """
    depth, limit = np.zeros(len(parent), np.int32), np.empty(len(parent), np.float32)
    for family in range(len(parent)):
        limit[family] = size[family]
        if parent[family] >= 0:
            depth[family] = depth[parent[family]] + 1
            limit[family] = min(limit[family], limit[parent[family]])
    return depth, limit
