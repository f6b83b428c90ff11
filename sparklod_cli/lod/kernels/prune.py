"""Prunes a binary tree: drops the least useful nodes, so that cuts of the remaining tree are nearly as good.

A node is drawn while the traversal's threshold is between its size and its parent's. While it is drawn it replaces k
children by one splat, at the cost of some error; its usefulness is the span of ln(size) over which that happens x
(k - 1 - error cost) x a rarity weight. When a node is dropped, its children become its parent's.
"""

from __future__ import annotations

import math

import numpy as np

from ...model.lod_tree import MAX_CHILDREN
from ...support.jit import kernel

#: Size steps per octave, and octaves: all of float32's, 2^-128 to 2^128. Steps chosen.
STEPS, OCTAVES = 4, 256

#: Least size that has a logarithm here, just above float32's least normal number.
LEAST_SIZE = np.float32(1e-37)

#: Error cost, in splats, of a node whose error is the mean at its size; it grows with the square root of the error.
#: Measured: 0.4 gains up to 0.7 dB at large budgets over 0, 1.0 loses up to 6 dB at small ones
#: (docs/decisions/2026-11-21-fidelity.md).
ERROR_COST = np.float32(0.4)

#: In cuts of less than this share of the leaves the error cost falls in proportion, as such cuts have no node to spare.
#: Chosen.
FEW = 0.2

#: The rarity weight of a node that is drawn in cuts of n splats is n to the power of -0.5. Chosen.
RARITY = 0.5

#: Nodes are dropped in this many rounds, which is nearly as good as one by one in order of usefulness. Chosen.
ROUNDS = 8

#: The most children of a node as long as any node can be dropped without exceeding it; then it doubles. A node that is
#: smaller than its children has no use by the rule above, and biker's root got 2,575 children, which left nothing to
#: draw with budgets between 1 and 2,575 (docs/decisions/2026-11-21-fidelity.md).
MOST_CHILDREN = 16

#: Bits of a float32 usefulness by which nodes are ordered: sign, exponent and 7 bits of fraction. Chosen.
KEY_BITS = 16


@kernel()
def size_step(size):
    """The size step of a node."""
    return min(max(int(STEPS * (math.log2(size) + OCTAVES / 2)), 0), STEPS * OCTAVES - 1)


@kernel()
def fill_usefulness_terms(children, leaves, size, error, log_size, weight, lost):
    """Fills the terms of `usefulness`.

    Args:
        children: (T, 2) uint32; parents come after their children, and the root is last.
        leaves: number of leaves; they come first.
        size: (T,) float32 feature sizes.
        error: (T,) float32, `picture_error`.
        log_size: (T,) float32, filled with ln(size), but no more than the parent's: the threshold above which the
            traversal does not refine the node.
        weight: (T,) float32, filled for merged nodes with their rarity weight.
        lost: (T,) float32, filled for merged nodes with their error cost, in splats.

    Returns:
        (T,) uint32 parents; the root's is itself.
    """
    total = len(size)
    parent = np.empty(total, np.uint32)
    parent[total - 1] = total - 1
    log_size[total - 1] = math.log(max(size[total - 1], LEAST_SIZE))
    count, inner, sums = np.zeros(STEPS * OCTAVES), np.zeros(STEPS * OCTAVES), np.zeros(STEPS * OCTAVES)
    for node in range(total - 1, -1, -1):
        if node < total - 1:
            own = np.float32(math.log(max(size[node], LEAST_SIZE)))
            log_size[node] = min(own, log_size[parent[node]])
        step = size_step(math.exp(log_size[node]))
        count[step] += 1
        if node >= leaves:
            parent[children[node, 0]] = parent[children[node, 1]] = node
            inner[step] += 1
            sums[step] += error[node]
    drawn, rare = 0.0, np.empty(STEPS * OCTAVES)
    for step in range(STEPS * OCTAVES - 1, -1, -1):
        drawn += count[step]  # roughly the splats of a cut with this threshold
        rare[step] = min(1.0, drawn / (FEW * leaves))
        count[step] = max(min(drawn, float(leaves)), 1.0) ** -RARITY
    for node in range(leaves, total):
        step = size_step(math.exp(log_size[node]))
        weight[node] = count[step]
        mean = sums[step] / inner[step]
        lost[node] = ERROR_COST * rare[step] * math.sqrt(error[node] / mean) if mean > 0 else 0.0
    return parent


@kernel()
def usefulness_key(useful):
    """The KEY_BITS highest bits of a float32 as an integer >= 0, in the order of the numbers."""
    bits = np.int64(np.float32(useful).view(np.int32))
    ordered = bits if bits >= 0 else np.int64(-0x80000000) - bits
    return (ordered + 0x80000000) >> (32 - KEY_BITS)


@kernel()
def drop_nodes(leaves, most, parent, log_size, weight, lost, saved):
    """Drops the least useful merged nodes until `most` are left.

    Args:
        leaves, log_size, weight, lost: as for `fill_usefulness_terms`; the error cost of a dropped node is added to
            its parent's.
        most: number of merged nodes to keep, at least 1, the root.
        parent: (T,) uint32, updated: the nearest ancestor that is kept.
        saved: (T,) int32, filled with the number of children minus 1 of merged nodes that are kept, -1 for dropped
            nodes, and 0 for leaves.
    """
    total = len(parent)
    saved[:leaves] = 0
    saved[leaves:] = 1
    left = total - leaves
    count = np.zeros(1 << KEY_BITS, np.int64)
    turn, children = ROUNDS, MOST_CHILDREN
    while left > most:  # also after ROUNDS, where nodes gained usefulness as their children were dropped
        count[:] = 0
        candidates = 0
        for node in range(leaves, total - 1):
            if saved[node] > 0 and saved[parent[node]] + saved[node] < children:
                count[usefulness_key(usefulness(node, parent, log_size, weight, lost, saved))] += 1
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
            if usefulness_key(usefulness(node, parent, log_size, weight, lost, saved)) <= threshold:
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
    """Usefulness of a merged node, see above: (span of ln(size)) * (children - 1 - error cost) * rarity weight."""
    return (log_size[parent[node]] - log_size[node]) * (np.float32(saved[node]) - lost[node]) * weight[node]


@kernel()
def size_ranks(leaves, parent, log_size, saved):
    """The rank of merged nodes in the final order: size steps below the root, and more than the parent's rank.

    Args:
        leaves, parent, log_size, saved: as for `drop_nodes`.

    Returns:
        (T,) int32, -1 for leaves and dropped nodes.
    """
    total = len(parent)
    rank = np.full(total, -1, np.int32)
    rank[total - 1] = 0
    top = log_size[total - 1]
    per_unit = np.float32(STEPS / math.log(2))
    for node in range(total - 2, leaves - 1, -1):
        if saved[node] > 0:
            own = np.int32(min((top - log_size[node]) * per_unit, np.float32(STEPS * OCTAVES)))
            rank[node] = max(own, rank[parent[node]] + 1)
    return rank


@kernel()
def lay_out_children(inner, parent, saved, order, child_start, child_count):
    """Assigns final indices: the root is 0, siblings are consecutive, and come in the order of their parents.

    Args:
        inner: (I,) uint32, the merged nodes that are kept, parents before their children.
        parent, saved: of `drop_nodes`.
        order: (M,) uint32, filled with the node of each final index.
        child_start, child_count: columns of a `LodTree` of M nodes, filled.

    Returns:
        (I,) uint32 final indices of `inner`.
    """
    total = len(parent)
    start = np.zeros(total, np.uint32)  # final index of a node's next child
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
    final = np.empty(len(inner), np.uint32)
    for i in range(len(inner)):
        final[i] = index[inner[i]]
        child_count[final[i]] = saved[inner[i]] + 1
        child_start[final[i]] = start[inner[i]] - (saved[inner[i]] + 1)
    return final
