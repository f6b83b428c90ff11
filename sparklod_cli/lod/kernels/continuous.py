"""What continuous cuts do with the inner nodes of a tree: put them in order, find their limits, blend them."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from ...support.jit_types import f4, f8, i8, out, u4
from .pixel_scale import NODES, VIEWS, pixel_scales

#: In place of an infinite limit, so that logarithms are finite.
LARGEST = np.finfo(np.float32).max


@kernel(NODES, out(i8[:]), out(i8[:]), nogil=True)
def order_inner(nodes, inner, above):
    """Puts the M inner nodes of a tree in the order of their depths, those of a depth by index.

    Args:
        nodes: `NODE` of the tree, children after their parents.
        inner: (M,) int64, filled with the nodes.
        above: (M,) int64, filled with the place of each one's parent; 0 for the root.
    """
    depth = np.zeros(len(nodes), np.int32)
    ends = np.zeros(len(nodes) + 1, np.int64)
    for node in range(len(nodes)):
        count, start = np.int64(nodes[node].child_count), np.int64(nodes[node].child_start)
        ends[depth[node] + 1] += count > 0
        for child in range(start, start + count):
            depth[child] = depth[node] + 1
    for at in range(len(nodes)):
        ends[at + 1] += ends[at]
    parent = np.zeros(len(nodes), np.int64)  # its place
    for node in range(len(nodes)):
        if nodes[node].child_count:
            inner[ends[depth[node]]] = node
            ends[depth[node]] += 1
    for place in range(len(inner)):
        node = inner[place]
        above[place] = parent[node]
        start = np.int64(nodes[node].child_start)
        parent[start : start + np.int64(nodes[node].child_count)] = place


@kernel(NODES, i8[:], i8[:], VIEWS, i8, out(f4[:]), nogil=True)
def find_limits(nodes, inner, above, views, number, limit):
    """Finds the least pixel scale on the path from the root to each inner node.

    Args:
        nodes: `NODE` of the tree.
        inner, above: as of `order_inner`.
        views: (instances,) `VIEW`.
        number: of the instance.
        limit: (M,) float32, filled; finite, at least 0.
    """
    pixel_scales(nodes, inner, views, number, limit)
    for place in range(len(inner)):
        limit[place] = min(limit[place], limit[above[place]])
    for place in range(len(inner)):
        limit[place] = min(limit[place], LARGEST)


@kernel(NODES, i8[:], f8[:], out(u4[:]), out(f8[:]), nogil=True)
def blend(nodes, inner, share, node, weight):
    """The nodes with a weight above 0, ascending.

    Args:
        nodes: `NODE` of the tree.
        inner: as of `order_inner`.
        share: (M,) float64 by which they are refined, 0..1.
        node: (nodes,) uint32, filled from the start.
        weight: (nodes,) float64, filled from the start.

    Returns:
        how many there are.
    """
    weight[:] = 0
    weight[0] = 1
    for place in range(len(inner)):
        if share[place] > 0:
            record = nodes[inner[place]]
            start = np.int64(record.child_start)
            weight[start : start + np.int64(record.child_count)] = share[place]
            weight[inner[place]] -= share[place]
    found = 0
    for at in range(len(nodes)):
        node[found], weight[found] = at, weight[at]
        found += weight[found] > 0
    return found
