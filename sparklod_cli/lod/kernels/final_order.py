"""Writes a tree in its final order: copies leaves and merged nodes to their indices, and averages colours there."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange, prefetch
from ...support.jit_types import f4, f8, i8, out, u2, u4

#: Leaves ahead whose input is fetched, as they lie anywhere in it: then their cache misses overlap. Measured.
AHEAD = 16

#: float32 of a cache line.
LINE = 16


@kernel(u4[:], u4[:], f4[:, :], out(f4[:, :]), parallel=True)
def fill_leaves(order, index, column, out):
    """Fills the leaves of a column in final order; rows of merged nodes are left as they are.

    Args:
        order: (M,) uint32, the node of each final index; those below n are leaves.
        index: (n,) uint32, the input splat of each leaf.
        column: (n, J) float32 of the input splats.
        out: (M, J) float32.
    """
    n, width, flat = len(order), column.shape[1], column.reshape(-1)
    for i in prange(n):
        ahead = order[min(i + AHEAD, n - 1)]
        if ahead < len(index):
            begin = np.int64(index[ahead]) * width
            for word in range(begin, begin + width, LINE):
                prefetch(flat, word)
            prefetch(flat, begin + width - 1)
        if order[i] < len(index):
            j = index[order[i]]
            for k in range(width):
                out[i, k] = column[j, k]


@kernel(
    (u4[:], u4[:], u2[:], u4[:], f4[:], out(f4[:, :]), i8),
    (u4[:], u4[:], u2[:], u4[:], f8[:], out(f4[:, :]), i8),
    parallel=True,
)
def merge_colors(parents, child_start, child_count, order, weight, color, blocks):
    """Fills the colours of nodes with the weighted mean of their children's, which must be filled already.

    Args:
        parents: (G,) final indices of the nodes.
        child_start, child_count: of the whole tree.
        order: (M,) uint32, the node of each final index.
        weight: (nodes,) of each node.
        color: (M, J) float32 in final order; rows `parents` are filled.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.
    """
    n, width = len(parents), color.shape[1]
    for block in prange(blocks):
        total = np.empty(width, np.float64)
        for g in range(n * block // blocks, n * (block + 1) // blocks):
            node = parents[g]
            total_weight = 0.0
            for k in range(width):
                total[k] = 0.0
            begin = np.int64(child_start[node])
            for child in range(begin, begin + child_count[node]):
                w = np.float64(weight[order[child]])
                total_weight += w
                for k in range(width):
                    total[k] += w * color[child, k]
            for k in range(width):
                color[node, k] = total[k] / total_weight
