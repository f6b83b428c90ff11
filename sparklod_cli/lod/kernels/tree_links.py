"""Follows the links of a tree that may be broken."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .geometry import ellipsoid_area

#: A tree has fewer links than nodes; of a broken one so many times as many are followed.
STEPS = 4


@kernel()
def walk(child_count, child_start, size):
    """Visits every node that the root leads to, once.

    In linear time whatever the links are: those of a broken tree, where nodes share children, are followed so often and
    no further.

    Args:
        child_count: (N,) of any unsigned type; N is at least 1.
        child_start: (N,) of any unsigned type.
        size: (N,) of each node, any unit.

    Returns:
        depth: (N,) int32, edges from the root by the first way found; -1 where none leads there.
        limit: (N,) float32, the least size from the root to the node on that way; 0 where none leads there.
    """
    count = len(child_count)
    depth = np.full(count, -1, np.int32)
    limit = np.zeros(count, np.float32)
    depth[0], limit[0] = 0, size[0]
    sound = True
    for node in range(count):  # in order, which is enough for a tree whose nodes come after their parents
        start = np.int64(child_start[node])
        end = start + np.int64(child_count[node])
        if start == end:
            continue
        sound = start > node and end <= count and depth[node] >= 0
        for child in range(start, end if sound else start):
            if depth[child] >= 0:
                sound = False
                break
            depth[child] = depth[node] + 1
            limit[child] = min(limit[node], size[child])
        if not sound:
            break
    if sound:
        return depth, limit
    depth[:], limit[:] = -1, 0
    depth[0], limit[0] = 0, size[0]
    queue = np.empty(count, np.int32)
    queue[0] = 0
    first, last, steps = 0, 1, 0
    while first < last and steps <= STEPS * count:
        node = queue[first]
        first += 1
        start = np.int64(child_start[node])
        end = min(count, start + np.int64(child_count[node]))
        steps += max(0, end - start)
        for child in range(start, end):
            if depth[child] < 0:
                depth[child] = depth[node] + 1
                limit[child] = min(limit[node], size[child])
                queue[last] = child
                last += 1
    return depth, limit


@kernel()
def find_parents(child_count, child_start):
    """Who has each node as a child, in linear time.

    Args:
        child_count: (N,) of any unsigned type.
        child_start: (N,) of any unsigned type.

    Returns:
        parent: (N,) int32, a node that has it as a child; -1 where there is none, or where links are too broken to be
            followed all.
        references: (N,) int64, how many nodes have it as a child.
    """
    count = len(child_count)
    parent = np.full(count, -1, np.int32)
    references = np.zeros(count + 1, np.int64)  # first how many runs of children begin here, less those that end
    steps = 0
    for node in range(count):
        start = np.int64(child_start[node])
        end = min(count, start + np.int64(child_count[node]))
        if start >= end:
            continue
        references[start] += 1
        references[end] -= 1
        steps += end - start
        if steps <= STEPS * count:
            for child in range(start, end):
                parent[child] = node
    for node in range(1, count):
        references[node] += references[node - 1]
    return parent, references[:count]


@kernel()
def sizes_below(parent, size, scale, opacity):
    """How large the children of each node are, in the mean by what they cover, in linear time.

    Args:
        parent: (N,) int32, of `find_parents`.
        size: (N,) of each node, any unit.
        scale: (N, 3) float32.
        opacity: (N,) float32, linear.

    Returns:
        (N,) float64: the mean of the children's sizes by opacity times surface; 0 where no child covers anything.
    """
    means, weights = np.zeros(len(parent)), np.zeros(len(parent))
    for node in range(len(parent)):
        if parent[node] >= 0 and opacity[node] > 0 and 0 < size[node] < np.inf:
            area = ellipsoid_area(scale[node, 0], scale[node, 1], scale[node, 2])
            weight = opacity[node] * max(area, 1e-300)
            weights[parent[node]] += weight
            means[parent[node]] += weight * size[node]
    for node in range(len(parent)):
        if weights[node] > 0:
            means[node] /= weights[node]
    return means


@kernel()
def find_cycles(parent, depth):
    """Nodes that the root does not lead to, and that have no topmost node above them either, in linear time.

    Args:
        parent: (N,) int32, of `find_parents`.
        depth: (N,) int32, of `walk`.

    Returns:
        (N,) bool: the node is on a cycle, or below one.
    """
    unknown, ends, cycle, passed = 0, 1, 2, 3
    state = np.zeros(len(parent), np.uint8)
    for node in range(len(parent)):
        at = node
        while at >= 0 and depth[at] < 0 and state[at] == unknown:
            state[at] = passed
            at = parent[at]
        found = ends
        if at >= 0 and depth[at] < 0:
            found = cycle if state[at] == passed else state[at]
        at = node
        while at >= 0 and state[at] == passed:
            state[at] = found
            at = parent[at]
    return state == cycle


@kernel()
def sum_levels(depth, child_count, size):
    """Counts and sizes of the nodes of each depth, in linear time; those of depth -1 are left out.

    Args:
        depth: (N,) int32.
        child_count: (N,) uint16.
        size: (N,) of each node, any unit.

    Returns:
        nodes, leaves: (levels,) int64, how many.
        logs: (levels,) float64, the sum of the logarithms of their sizes.
        children: (65536,) int64, how many nodes, of any depth, have so many children.
    """
    levels = depth.max() + 1
    nodes = np.zeros(levels, np.int64)
    leaves = np.zeros(levels, np.int64)
    logs = np.zeros(levels, np.float64)
    children = np.zeros(1 << 16, np.int64)
    for node in range(len(depth)):
        children[child_count[node]] += 1
        if depth[node] >= 0:
            nodes[depth[node]] += 1
            leaves[depth[node]] += child_count[node] == 0
            logs[depth[node]] += np.log(size[node])
    return nodes, leaves, logs, children
