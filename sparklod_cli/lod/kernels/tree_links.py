"""Linear-time checks and statistics of the parent-child links of a tree that may be invalid.

Arrays are (N,), a value for each node: `child_count` and `child_start` of any unsigned type, `size` in any unit,
`parent` and `depth` of `find_parents` and `find_depths`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...system.jit import b1, f4, f8, i4, i8, kernel, out, u1, u2, u4
from .geometry import ellipsoid_area

#: Maximum number of followed links per node. A tree has fewer than one; in a broken tree nodes may share children, so
#: that the number of links can be the square of that of nodes. Chosen.
MAX_LINKS = 4

#: Number of the upper bits of limits, as float32, by which nodes are counted.
LIMIT_BITS = 16

#: Least surface area of a child, so that children whose areas are 0 in float64 count equally. Chosen.
LEAST_AREA = 1e-300


def find_depths(
    child_count: NDArray[Any], child_start: NDArray[Any], size: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return depths and limits of the nodes that are reachable from the root; N is at least 1.

    Takes linear time for any links: at most MAX_LINKS per node are followed.

    Returns:
        depth: int32, edges from the root on the first path found; -1 for unreachable nodes.
        limit: float32, least size on this path, the node's included; 0 for unreachable nodes.
    """
    depth, limit = np.empty(len(child_count), np.int32), np.empty(len(child_count), np.float32)
    fill_depths(child_count, child_start, size, depth, limit)
    return depth, limit


@kernel(u2[:], u4[:], f4[:], out(i4[:]), out(f4[:]))
def fill_depths(child_count, child_start, size, depth, limit):
    """Fill the arrays of `find_depths`."""
    count = len(child_count)
    depth[:], limit[:] = -1, 0
    depth[0], limit[0] = 0, size[0]
    sound = True
    for node in range(count):  # in order, which suffices for a tree whose nodes come after their parents
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
        return
    depth[:], limit[:] = -1, 0
    depth[0], limit[0] = 0, size[0]
    queue = np.empty(count, np.int32)
    queue[0] = 0
    first, last, steps = 0, 1, 0
    while first < last and steps <= MAX_LINKS * count:
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


def find_parents(child_count: NDArray[Any], child_start: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return parents of all nodes.

    Returns:
        parent: int32, the last node with this node as a child, among the followed links, MAX_LINKS per node; else -1.
        references: int32, number of nodes with this node as a child.
    """
    parent, references = np.empty(len(child_count), np.int32), np.empty(len(child_count) + 1, np.int32)
    fill_parents(child_count, child_start, parent, references)
    return parent, references[:-1]


@kernel(u2[:], u4[:], out(i4[:]), out(i4[:]))
def fill_parents(child_count, child_start, parent, references):
    """Fill the arrays of `find_parents`; `references` has one element more."""
    count = len(child_count)
    parent[:] = -1
    references[:] = 0  # at first: ranges of children that begin here, less those that end
    steps = 0
    for node in range(count):
        start = np.int64(child_start[node])
        end = min(count, start + np.int64(child_count[node]))
        if start >= end:
            continue
        references[start] += 1
        references[end] -= 1
        steps += end - start
        if steps <= MAX_LINKS * count:
            for child in range(start, end):
                parent[child] = node
    for node in range(1, count):
        references[node] += references[node - 1]


@kernel(i4[:], f4[:], f4[:, :], f4[:], out(f8[:]))
def fill_weights(parent, size, scale, opacity, weight):
    """Fill the weights of nodes in the mean size of their parents' children: linear opacity times surface area.

    The weight of a node without a parent, a positive opacity or a positive, finite size is -1.
    """
    for node in range(len(parent)):
        weight[node] = -1
        if parent[node] >= 0 and opacity[node] > 0 and 0 < size[node] < np.inf:
            area = ellipsoid_area(scale[node, 0], scale[node, 1], scale[node, 2])
            weight[node] = opacity[node] * max(area, LEAST_AREA)


@kernel(i4[:], f4[:], f8[:], out(f8[:]), out(f8[:]))
def add_weighted(parent, size, weight, sums, weights):
    """Add a block of nodes to the sums of their parents' children, whose mean size is `sums` over `weights`.

    Sums are in the order of nodes, so that they do not depend on the blocks.
    """
    for node in range(len(parent)):
        if not weight[node] < 0:
            weights[parent[node]] += weight[node]
            sums[parent[node]] += weight[node] * size[node]


#: States of nodes in `find_cycles`.
UNKNOWN, ENDS, CYCLE, PASSED = 0, 1, 2, 3


def find_cycles(parent: NDArray[Any], depth: NDArray[Any]) -> NDArray[Any]:
    """Return whether each node is on a cycle or below one, so that no ancestor is the root or lacks a parent."""
    state = np.full(len(parent), UNKNOWN, np.uint8)
    fill_states(parent, depth, state)
    return state == CYCLE


@kernel(i4[:], i4[:], out(u1[:]))
def fill_states(parent, depth, state):
    """Replace the state UNKNOWN of nodes whose depth is -1 by CYCLE or ENDS."""
    for node in range(len(parent)):
        at = node
        while at >= 0 and depth[at] < 0 and state[at] == UNKNOWN:
            state[at] = PASSED
            at = parent[at]
        found = ENDS
        if at >= 0 and depth[at] < 0:
            found = CYCLE if state[at] == PASSED else state[at]
        at = node
        while at >= 0 and state[at] == PASSED:
            state[at] = found
            at = parent[at]


def sum_by_depth(
    depth: NDArray[Any], child_count: NDArray[Any], size: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return statistics of the nodes by depth, without unreachable nodes, of depth -1.

    Returns:
        nodes, leaves: (depths,) int64 numbers.
        logs: (depths,) float64 sums of ln(size).
        children: (65536,) int64 numbers of nodes, unreachable ones too, by number of children.
    """
    depths = depth.max() + 1
    nodes, leaves, logs = np.zeros(depths, np.int64), np.zeros(depths, np.int64), np.zeros(depths, np.float64)
    children = np.zeros(1 << 16, np.int64)
    add_by_depth(depth, child_count, size, nodes, leaves, logs, children)
    return nodes, leaves, logs, children


@kernel(i4[:], u2[:], f4[:], out(i8[:]), out(i8[:]), out(f8[:]), out(i8[:]))
def add_by_depth(depth, child_count, size, nodes, leaves, logs, children):
    """Add nodes to the arrays of `sum_by_depth`."""
    for node in range(len(depth)):
        children[child_count[node]] += 1
        if depth[node] >= 0:
            nodes[depth[node]] += 1
            leaves[depth[node]] += child_count[node] == 0
            logs[depth[node]] += np.log(size[node])


@kernel(u2[:], u4[:], f4[:], i8, out(i8[:]), returns=i8)
def count_limits(child_count, child_start, limit, chunk_bits, counts):
    """Add inner nodes with limits above 0 to (1 << LIMIT_BITS,) counts, by the upper bits of their limits.

    Returns:
        number of inner nodes, of any limit, with children in more than one chunk of 2 ** chunk_bits nodes.
    """
    bits = limit.view(np.uint32)
    split = 0
    for node in range(len(child_count)):
        if child_count[node] > 0:
            first = np.int64(child_start[node])
            split += first >> chunk_bits != (first + np.int64(child_count[node]) - 1) >> chunk_bits
            if limit[node] > 0:
                counts[bits[node] >> np.uint32(32 - LIMIT_BITS)] += 1
    return split


@kernel(u2[:], u4[:], f4[:], f8, out(b1[:]), returns=i8)
def mark_small(child_count, child_start, size, ratio, marks):
    """Mark nodes smaller than `ratio` times a child of finite size; return the number of marked nodes."""
    count, marked, steps = len(child_count), 0, 0
    for node in range(count):
        start = np.int64(child_start[node])
        end = min(count, start + np.int64(child_count[node]))
        steps += max(0, end - start)
        if steps > MAX_LINKS * count:
            marks[node] = start < end  # a broken tree may have too many links to follow
        most = np.float32(0)
        for child in range(start, start if marks[node] else end):
            if most < size[child] < np.inf:
                most = size[child]
        if np.float64(size[node]) < ratio * np.float64(most):
            marks[node] = True
        marked += marks[node]
    return marked


def find_limits(parent: NDArray[Any], size: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return int32 depths, edges from the root, and float32 limits of the nodes that have children.

    `parent` is the place of each node's parent among these nodes, which comes before it, -1 for the root; a limit is
    the least size from the root to the node, its own included.
    """
    depth, limit = np.empty(len(parent), np.int32), np.empty(len(parent), np.float32)
    fill_limits(parent, size, depth, limit)
    return depth, limit


@kernel(i4[:], f4[:], out(i4[:]), out(f4[:]))
def fill_limits(parent, size, depth, limit):
    """Fill the arrays of `find_limits`."""
    for family in range(len(parent)):
        depth[family], limit[family] = 0, size[family]
        if parent[family] >= 0:
            depth[family] = depth[parent[family]] + 1
            limit[family] = min(limit[family], limit[parent[family]])
