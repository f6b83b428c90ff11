"""Which nodes of a binary tree to keep: a tree of fewer nodes whose cuts are as good.

A node is drawn while the traversal's threshold is between its size and its parent's, over a range of the logarithm of
sizes. Meanwhile it saves its children but one, and is off by its error. So much of both is what it is good for; the
least useful nodes are dropped, and their children become their parents'.
"""

from __future__ import annotations

import math

import numpy as np

from ...model.lod_tree import MAX_CHILDREN
from ...support.jit import kernel

#: Sizes are told apart in so many steps an octave, over octaves of float32.
STEPS, OCTAVES = 4, 256

#: How much the error of a node counts beside the splats that it saves; errors by their square root, beside that of
#: what is common at its size.
ERROR_COST = np.float32(0.4)

#: In cuts of less than this share of the leaves errors count less: of so few nodes none can be spared.
COMMON = 0.2

#: A node that is drawn in cuts of n splats is worth this power of 1/n.
RARITY = 0.5

#: Dropping in so many rounds is nearly as good as one after the other, the least useful first.
ROUNDS = 8

#: No node gets more children unless no other can be dropped: where a node is smaller than those below it they are of no
#: use by the rule above, yet a budget between one and thousands would have nothing to spend on.
MOST_CHILDREN = 16

#: Useful numbers are told apart by this many of their bits.
KEY_BITS = 16


@kernel()
def step_of(size):
    """Which step of size a node has."""
    return min(max(int(STEPS * (math.log2(size) + OCTAVES / 2)), 0), STEPS * OCTAVES - 1)


@kernel()
def value_nodes(children, leaves, size, error, log_size, weight, lost):
    """What usefulness is made of.

    Args:
        children: (T, 2) uint32; parents come after their children, the last is the root.
        leaves: how many there are; they come first.
        size: (T,) float32 that the traversal sees. error: (T,) float32.
        log_size: (T,) float32, filled: ln of the size from which on the traversal divides a node, which is no more than
            its parent's.
        weight: (T,) float32, filled: how much a node counts by its size.
        lost: (T,) float32, filled: its error in splats.

    Returns:
        parent (T,) uint32, that of the root itself.
    """
    total = len(size)
    parent = np.empty(total, np.uint32)
    parent[total - 1] = total - 1
    log_size[total - 1] = math.log(max(size[total - 1], np.float32(1e-37)))
    count, inner, sums = np.zeros(STEPS * OCTAVES), np.zeros(STEPS * OCTAVES), np.zeros(STEPS * OCTAVES)
    for node in range(total - 1, -1, -1):
        if node < total - 1:
            own = np.float32(math.log(max(size[node], np.float32(1e-37))))
            log_size[node] = min(own, log_size[parent[node]])
        step = step_of(math.exp(log_size[node]))
        count[step] += 1
        if node >= leaves:
            parent[children[node, 0]] = parent[children[node, 1]] = node
            inner[step] += 1
            sums[step] += error[node]
    drawn, rare = 0.0, np.empty(STEPS * OCTAVES)
    for step in range(STEPS * OCTAVES - 1, -1, -1):
        drawn += count[step]  # about so many splats are in a cut down to here
        rare[step] = min(1.0, drawn / (COMMON * leaves))
        count[step] = max(min(drawn, float(leaves)), 1.0) ** -RARITY
    for node in range(leaves, total):
        step = step_of(math.exp(log_size[node]))
        weight[node] = count[step]
        common = sums[step] / inner[step]
        lost[node] = ERROR_COST * rare[step] * math.sqrt(error[node] / common) if common > 0 else 0.0
    return parent


@kernel()
def key_of(useful):
    """The highest bits of a float32, in its order."""
    bits = np.int64(np.float32(useful).view(np.int32))
    ordered = bits if bits >= 0 else np.int64(-0x80000000) - bits
    return (ordered + 0x80000000) >> (32 - KEY_BITS)


@kernel()
def drop_nodes(leaves, most, parent, log_size, weight, lost, saved):
    """Drops merged nodes until `most` are left.

    Args:
        leaves, log_size, weight, lost: of `value_nodes`; lost is added to.
        most: how many merged nodes to keep, at least the root.
        parent: (T,) uint32, becomes that of the nearest that is kept.
        saved: (T,) int32, filled: children less one of what is kept, -1 for what is dropped and 0 for leaves.
    """
    total = len(parent)
    saved[:leaves] = 0
    saved[leaves:] = 1
    left = total - leaves
    count = np.zeros(1 << KEY_BITS, np.int64)
    turn, children = ROUNDS, MOST_CHILDREN
    while left > most:  # the last rounds find what became more useful meanwhile
        count[:] = 0
        candidates = 0
        for node in range(leaves, total - 1):
            if saved[node] > 0 and saved[parent[node]] + saved[node] < children:
                count[key_of(usefulness(node, parent, log_size, weight, lost, saved))] += 1
                candidates += 1
        if candidates == 0:
            if children == MAX_CHILDREN:
                break
            children = min(2 * children, MAX_CHILDREN)
            continue
        wanted, threshold, below = min(max((left - most) // turn, 1), candidates), 0, 0
        while below + count[threshold] < wanted:
            below += count[threshold]
            threshold += 1
        for node in range(leaves, total - 1):
            if left <= most:
                break
            above = parent[node]
            if saved[node] < 1 or saved[above] + saved[node] >= children:
                continue
            if key_of(usefulness(node, parent, log_size, weight, lost, saved)) <= threshold:
                saved[above] += saved[node]
                lost[above] += lost[node]
                saved[node] = -1
                left -= 1
        for node in range(total - 2, -1, -1):
            if saved[parent[node]] < 0:
                parent[node] = parent[parent[node]]
        turn = max(turn - 1, 1)


@kernel(inline=True)
def usefulness(node, parent, log_size, weight, lost, saved):
    """What a node is good for, see above."""
    return (log_size[parent[node]] - log_size[node]) * (np.float32(saved[node]) - lost[node]) * weight[node]


@kernel()
def levels_of(leaves, parent, log_size, saved):
    """(T,) int32 level of each merged node that is kept, the higher the smaller, and above its parent's; else -1."""
    total = len(parent)
    level = np.full(total, -1, np.int32)
    level[total - 1] = 0
    top = log_size[total - 1]
    per = np.float32(STEPS / math.log(2))
    for node in range(total - 2, leaves - 1, -1):
        if saved[node] > 0:
            own = np.int32(min((top - log_size[node]) * per, np.float32(STEPS * OCTAVES)))
            level[node] = max(own, level[parent[node]] + 1)
    return level


@kernel()
def place_nodes(inner, parent, saved, order, child_start, child_count):
    """Puts the children of nodes side by side, in the order of their parents.

    Args:
        inner: (I,) uint32, the merged nodes that are kept, parents before their children.
        parent, saved: of `drop_nodes`.
        order: (M,) uint32, filled: the node of each final index.
        child_start, child_count: of a LodTree of M nodes, filled.

    Returns:
        place (I,) uint32: final index of each of `inner`.
    """
    total = len(parent)
    start = np.zeros(total, np.uint32)  # where the next child of a node goes
    at = 1
    for node in inner:
        start[node] = at
        at += saved[node] + 1
    index = np.empty(total, np.uint32)
    order[0] = total - 1
    index[total - 1] = 0
    for node in range(total - 2, -1, -1):
        if saved[node] >= 0:
            above = parent[node]
            index[node] = start[above]
            order[start[above]] = node
            start[above] += 1
    place = np.empty(len(inner), np.uint32)
    for i in range(len(inner)):
        place[i] = index[inner[i]]
        child_count[place[i]] = saved[inner[i]] + 1
        child_start[place[i]] = start[inner[i]] - (saved[inner[i]] + 1)
    return place
