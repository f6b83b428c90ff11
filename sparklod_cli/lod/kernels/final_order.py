"""Final order: copying leaves and merged nodes to their place, and merging colours there."""

from __future__ import annotations

import numpy as np
from numba import prange

from ...support.jit import kernel
from .geometry import CENTER, OPACITY, QUAT, SCALE


@kernel(parallel=True)
def places_of_merged(order, leaves):
    """(M - leaves,) uint32: the final index of each merged node, by (M,) `order`, the node of each final index."""
    place = np.empty(len(order) - leaves, np.uint32)
    for i in prange(len(order)):
        if order[i] >= leaves:
            place[order[i] - leaves] = i
    return place


@kernel(parallel=True)
def fill_columns(order, geometry, leaves, shrink, center, scale, quat, opacity):
    """Columns of splats (arguments after `shrink`) in final order: row i from geometry[order[i]].

    Rows from `leaves` on are merged nodes, whose scales are multiplied by `shrink`, float32.
    """
    for i in prange(len(order)):
        j = order[i]
        factor = shrink if j >= leaves else np.float32(1)
        for k in range(3):
            center[i, k] = geometry[j, CENTER + k]
            scale[i, k] = geometry[j, SCALE + k] * factor
        for k in range(4):
            quat[i, k] = geometry[j, QUAT + k]
        opacity[i] = geometry[j, OPACITY]


@kernel(parallel=True)
def fill_leaves(order, index, column, out):
    """A column of the leaves in final order: row i from splat index[order[i]]; rows of merged nodes are left alone."""
    for i in prange(len(order)):
        if order[i] < len(index):
            j = index[order[i]]
            for k in range(column.shape[1]):
                out[i, k] = column[j, k]


@kernel(parallel=True)
def merge_colors(place, child_start, child_count, order, weight, color, chunks):
    """Weighted mean colour of the children of nodes, whose children's colours are in place.

    Args:
        place: (G,) final indices of the nodes.
        child_start, child_count: of the whole tree.
        order, weight: node of each final index, and weight of each node, float64.
        color: (M, J) float32 in final order, rows `place` are filled.
        chunks: how many pieces to work in.
    """
    n, width = len(place), color.shape[1]
    for c in prange(chunks):
        total = np.empty(width, np.float64)
        for g in range(n * c // chunks, n * (c + 1) // chunks):
            node = place[g]
            total_weight = 0.0
            for k in range(width):
                total[k] = 0.0
            begin = np.int64(child_start[node])
            for child in range(begin, begin + child_count[node]):
                w = weight[order[child]]
                total_weight += w
                for k in range(width):
                    total[k] += w * color[child, k]
            for k in range(width):
                color[node, k] = total[k] / total_weight
