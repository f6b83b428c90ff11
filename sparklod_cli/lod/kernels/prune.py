"""Prunes a binary tree: drops the least useful nodes, so that cuts of the remaining tree are nearly as good.

A node is drawn while the traversal's threshold is between its size and its parent's. It then replaces k children by
one splat, at the cost of some error. Its usefulness is the span of these thresholds in ln(size) x (k - 1 - error cost)
x a rarity weight. The children of a dropped node become children of its parent.

Arrays are those of `quality.fill_usefulness_terms` and `drop_nodes`: nodes from `leaves` on, of T, are merged.
Blocks of a range have about the same size, and `counts` a row for each, to which kernels add.
"""

from __future__ import annotations

import math

import numpy as np

from ...system.jit import f4, f8, i4, i8, kernel, out, u2, u4

#: Size steps per octave, and octaves: all of float32's, 2^-128 to 2^128. Steps chosen.
STEPS, OCTAVES = 4, 256

#: Least size of which the logarithm is taken, just above float32's least normal number.
LEAST_SIZE = np.float32(1e-37)

#: Error cost, in splats, of a node whose error is the mean at its size; it grows with the square root of the error.
#: Measured: 0.4 gains up to 0.7 dB at large budgets over 0, 1.0 loses up to 6 dB at small ones
#: (benchmarks/notes/quality-builder.md).
ERROR_COST = np.float32(0.4)

#: In cuts of less than this share of the leaves, the error cost falls in proportion: small cuts need each node. Chosen.
FEW = 0.2

#: The rarity weight of a node that is drawn in cuts of n splats is n to the power of -0.5. Chosen.
RARITY = 0.5

#: Nodes are dropped in this many rounds, which is nearly as good as one by one in order of usefulness. Chosen.
ROUNDS = 8

#: Maximum number of children while nodes can be dropped within it; then it doubles. Without it, as a node smaller than
#: its children has no usefulness, biker's root got 2,575 children: budgets between 1 and 2,575 drew the root alone
#: (benchmarks/notes/quality-builder.md).
MOST_CHILDREN = 16

#: ln(size) of a root of unknown size: larger than any. Chosen.
ABOVE_ALL = np.float32(1e6)

#: Span of ln(size) of a node whose parent is that root. The mean is 0.26 before pruning and 0.43 after it, measured.
UNKNOWN_SPAN = np.float32(0.3)

#: Subtracted from such a root's count in `saved` of `quality.drop_nodes`, so that it may have any number of children.
ROOM = 1 << 30

#: The rank of a node that is dropped.
NO_RANK = np.int32(-(1 << 31))

#: Bits of a float32 usefulness by which nodes are ordered: sign, exponent and 7 bits of fraction. Chosen.
KEY_BITS = 16
LAST_KEY = (1 << KEY_BITS) - 1


@kernel()
def size_step(size):
    """Return the size step of a node."""
    return min(max(int(STEPS * (math.log2(size) + OCTAVES / 2)), 0), STEPS * OCTAVES - 1)


@kernel(u4[:, :], i8, f4[:], out(u4[:]), out(f4[:]), out(u2[:]), out(i8[:]), out(f8[:]))
def link(children, leaves, lost, parent, log_size, step_of, inner, sums):
    """Fill the parents, the logarithms of sizes of merged nodes, and sums over merged nodes.

    On one thread, so that the rounding of the sums does not depend on threads.

    Args:
        log_size: sizes; replaced from `leaves` on.
        parent: (top + 1,) the root for all nodes; filled.
        step_of: (T - leaves,) filled with the size steps of merged nodes.
        inner, sums: (STEPS * OCTAVES,) increased by the number of merged nodes of each step, and their picture errors.
    """
    total = leaves + len(children)
    if len(parent) > total:
        log_size[total] = ABOVE_ALL
    for node in range(total - 1, leaves - 1, -1):
        log_size[node] = math.log(max(log_size[node], LEAST_SIZE))
        log_size[node] = min(log_size[node], log_size[parent[node]])  # the root's parent is itself
        parent[children[node - leaves, 0]] = parent[children[node - leaves, 1]] = node
        step = size_step(math.exp(log_size[node]))
        step_of[node - leaves] = step
        inner[step] += 1
        sums[step] += lost[node - leaves]


@kernel(i8, i8, u4[:], out(f4[:]), out(i8[:, :]), ranges=True)
def count_leaves(begin, end, leaves, parent, log_size, counts):
    """Replace the sizes of leaves by their logarithms, and count blocks of them by size step."""
    blocks = len(counts)
    for block in range(begin, end):
        for leaf in range(leaves * block // blocks, leaves * (block + 1) // blocks):
            log_size[leaf] = math.log(max(log_size[leaf], LEAST_SIZE))
            log_size[leaf] = min(log_size[leaf], log_size[parent[leaf]])
            counts[block, size_step(math.exp(log_size[leaf]))] += 1


@kernel(i8, u2[:], f8[:], f8[:], f8[:], out(f4[:]), out(f4[:]), ranges=True)
def fill_terms(start, stop, step_of, common, rare, mean, lost, weight):
    """Fill the rarity weights and error costs of merged nodes.

    Args:
        common, rare, mean: (STEPS * OCTAVES,) rarity weight of each step, factor of the error cost in its cuts, and
            mean picture error of its nodes.
    """
    for slot in range(start, stop):
        step = step_of[slot]
        weight[slot] = common[step]
        lost[slot] = ERROR_COST * rare[step] * math.sqrt(lost[slot] / mean[step]) if mean[step] > 0 else 0.0


@kernel()
def usefulness_key(useful):
    """Return the KEY_BITS highest bits of a float32 as an integer >= 0, in the order of the numbers."""
    bits = np.int64(np.float32(useful).view(np.int32))
    ordered = bits if bits >= 0 else np.int64(-0x80000000) - bits
    return (ordered + 0x80000000) >> (32 - KEY_BITS)


@kernel(i8, u4[:], i8, i8, f4[:], f4[:], f4[:], i4[:], out(u4[:]), out(u2[:]), out(i4[:, :]), ranges=True)
def count_by_key(begin, end, kept, leaves, children, log_size, lost, weight, saved, parent, keys, counts):
    """Update the parents of merged nodes, and count those that can be dropped by the keys of their usefulness.

    Args:
        kept: (n,) merged nodes but the root, less `leaves`, parents first.
        children: maximum number of children of a node.
        keys: (T - leaves - 1,) filled for `kept`; LAST_KEY if the node cannot be dropped.
        counts: (blocks, 1 << KEY_BITS).
    """
    blocks = len(counts)
    for block in range(begin, end):
        for i in range(len(kept) * block // blocks, len(kept) * (block + 1) // blocks):
            node = kept[i]
            find_parent(node + leaves, leaves, saved, parent)
            keys[node] = LAST_KEY
            if can_be_dropped(node, leaves, parent, saved, children):
                key = usefulness_key(usefulness(node, leaves, parent, log_size, lost, weight, saved))
                keys[node] = key
                counts[block, key] += 1


@kernel(i8, i8, i8, i8, u4[:], f4[:], f4[:], out(u4[:]), out(u2[:]), out(f4[:]), out(i4[:]), returns=i8)
def drop_below(threshold, most, leaves, children, parent, log_size, weight, kept, keys, lost, saved):
    """Drop at most `most` nodes whose keys are no larger than a threshold; return how many.

    Of the arrays of `count_by_key`, `keys`, `lost` and `saved` are updated, and the nodes still kept move to the end of
    `kept`.
    """
    after = len(kept)
    dropped = 0
    for i in range(len(kept) - 1, -1, -1):
        node = kept[i]
        if (
            keys[node] <= threshold
            and dropped < most
            and can_be_dropped(node, leaves, parent, saved, children)
            and usefulness_key(usefulness(node, leaves, parent, log_size, lost, weight, saved)) <= threshold
        ):
            above = parent[node + leaves] - leaves
            saved[above] += saved[node]
            lost[above] += lost[node]
            saved[node] = -1
            dropped += 1
            if above < len(keys):
                keys[above] = 0  # its usefulness has changed, and is computed again in its turn
        else:
            after -= 1
            kept[after] = node
    return dropped


@kernel(i8, i8, i4[:], out(u4[:]), ranges=True)
def skip_dropped(start, stop, leaves, saved, parent):
    """Update the parents of leaves and of merged nodes that are kept; arguments of `quality.drop_nodes`."""
    for node in range(start, stop):
        if node < leaves or saved[node - leaves] != -1:
            find_parent(node, leaves, saved, parent)


@kernel(inline=True)
def find_parent(node, leaves, saved, parent):
    """Update the parent of a node: the nearest ancestor that is kept.

    The parents of dropped nodes do not change, so that no thread reads a value that another one writes.
    """
    while saved[parent[node] - leaves] == -1:  # once for each round at most
        parent[node] = parent[parent[node]]


@kernel(inline=True)
def can_be_dropped(node, leaves, parent, saved, children):
    """Return whether merged node `leaves + node` is still kept, and its parent has room for its children."""
    return saved[node] > 0 and saved[parent[node + leaves] - leaves] + saved[node] < children


@kernel(inline=True)
def usefulness(node, leaves, parent, log_size, lost, weight, saved):
    """Return the usefulness of merged node `leaves + node`: span of ln(size) * (children - 1 - cost) * weight."""
    span = log_size[parent[node + leaves]] - log_size[node + leaves]
    if span > ABOVE_ALL / 2:
        span = UNKNOWN_SPAN
    return span * (np.float32(saved[node]) - lost[node]) * weight[node]


@kernel(i8, f4, u4[:], f4[:], i4[:], i4[:], out(i4[:]))
def fill_size_ranks(leaves, highest, parent, log_size, saved, latest, rank):
    """Fill (T - leaves,) ranks of merged nodes in the final order, NO_RANK for dropped nodes.

    A rank is the number of size steps below `highest`, the ln(size) of rank 0; it is above the parent's. `latest` is
    empty, or has an upper bound, exclusive, of the rank of each leaf's parent.
    """
    total = len(parent)
    rank[:] = NO_RANK
    per_unit = np.float32(STEPS / math.log(2))
    for node in range(total - 1, leaves - 1, -1):
        if saved[node - leaves] != -1:
            own = np.int32(min((highest - log_size[node]) * per_unit, np.float32(STEPS * OCTAVES)))
            if node < total - 1:
                own = max(own, rank[parent[node] - leaves] + 1)
            rank[node - leaves] = own
    if len(latest):
        for node in range(total - 1):
            if node < leaves:
                own = latest[node]
            elif saved[node - leaves] > 0:
                own = rank[node - leaves]
            else:
                continue
            above = parent[node] - leaves
            rank[above] = min(rank[above], own - 1)


@kernel(u4[:], i8, u4[:], i4[:], out(u4[:]), out(u4[:]), out(u2[:]), out(u4[:]))
def lay_out_children(inner, leaves, parent, saved, order, child_start, child_count, final):
    """Assign final indices: the root is 0, siblings are consecutive, and come in the order of their parents.

    Args:
        inner: (I,) the merged nodes that are kept, parents before their children.
        order: (M,) filled with the node of each final index.
        child_start, child_count: columns of a `LodTree` of M nodes, filled.
        final: (I,) filled with the final indices of `inner`.
    """
    total = len(parent)
    start = np.zeros(total - leaves, np.uint32)  # final index of a node's next child
    at = 1
    for node in inner:
        start[node - leaves] = at
        at += saved[node - leaves] + 1
    index = np.empty(total - leaves, np.uint32)
    order[0] = total - 1
    index[total - 1 - leaves] = 0
    for node in range(total - 2, -1, -1):
        if node < leaves or saved[node - leaves] >= 0:
            above = parent[node] - leaves
            order[start[above]] = node
            if node >= leaves:
                index[node - leaves] = start[above]
            start[above] += 1
    for i in range(len(inner)):
        own = inner[i] - leaves
        final[i] = index[own]
        child_count[final[i]] = saved[own] + 1
        child_start[final[i]] = start[own] - (saved[own] + 1)
