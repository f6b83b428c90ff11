"""Follows the links of a tree that may be broken."""

from __future__ import annotations

import numpy as np

from ...jit import kernel


@kernel()
def walk(child_count, child_start, size):
    """Visits every node that the root leads to, once, in linear time, whatever the links are.

    Args:
        child_count: (N,) of any unsigned type; N is at least 1.
        child_start: (N,) of any unsigned type.
        size: (N,) of each node, any unit.

    Returns:
        parent: (N,) int64, the node of the lowest index that has it as a child; -1 where there is none.
        references: (N,) int32, how many nodes have it as a child.
        depth: (N,) int32, edges from the root by the first way found; -1 where none leads there.
        limit: (N,) float32, the least size from the root to the node on that way; 0 where none leads there.
    """
    count = len(child_count)
    parent = np.full(count, -1, np.int64)
    references = np.zeros(count, np.int32)
    for node in range(count):
        start = np.int64(child_start[node])
        for child in range(start, min(count, start + np.int64(child_count[node]))):
            if references[child] == 0:
                parent[child] = node
            references[child] += 1
    depth = np.full(count, -1, np.int32)
    limit = np.zeros(count, np.float32)
    queue = np.empty(count, np.int64)
    depth[0], limit[0], queue[0] = 0, size[0], 0
    first, last = 0, 1
    while first < last:
        node = queue[first]
        first += 1
        start = np.int64(child_start[node])
        for child in range(start, min(count, start + np.int64(child_count[node]))):
            if depth[child] < 0:
                depth[child] = depth[node] + 1
                limit[child] = min(limit[node], size[child])
                queue[last] = child
                last += 1
    return parent, references, depth, limit
