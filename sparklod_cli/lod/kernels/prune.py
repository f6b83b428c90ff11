"""Prunes a binary tree: drops the least useful nodes, so that cuts of the remaining tree are nearly as good.

A node is drawn while the traversal's threshold is between its size and its parent's. While it is drawn it replaces k
children by one splat, at the cost of some error; its usefulness is the span of ln(size) over which that happens x
(k - 1 - error cost) x a rarity weight. When a node is dropped, its children become its parent's.
"""

from __future__ import annotations

import math

import numpy as np

from ...model.lod_tree import MAX_CHILDREN
from ...support.jit import kernel, prange
from ...support.jit_types import f4, i4, i8, out, u2, u4

#: Size steps per octave, and octaves: all of float32's, 2^-128 to 2^128. Steps chosen.
STEPS, OCTAVES = 4, 256

#: Least size that has a logarithm here, just above float32's least normal number.
LEAST_SIZE = np.float32(1e-37)

#: Error cost, in splats, of a node whose error is the mean at its size; it grows with the square root of the error.
#: Measured: 0.4 gains up to 0.7 dB at large budgets over 0, 1.0 loses up to 6 dB at small ones
#: (benchmarks/notes/quality-builder.md).
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
#: draw with budgets between 1 and 2,575 (benchmarks/notes/quality-builder.md).
MOST_CHILDREN = 16

#: ln(size) of a root whose own size is not known yet: larger than any. Chosen.
ABOVE_ALL = np.float32(1e6)

#: Span of ln(size) of a node whose parent is that root. The mean is 0.26 before pruning and 0.43 after it, measured.
UNKNOWN_SPAN = np.float32(0.3)

#: What such a root has less in `saved` of `drop_nodes`: it may have any number of children.
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


@kernel(u4[:, :], i8, i8, i8, out(f4[:]), out(f4[:]), out(f4[:]), i8, parallel=True)
def fill_usefulness_terms(children, leaves, drawn_leaves, top, log_size, lost, weight, blocks):
    """Fill the terms of `usefulness`.

    Args:
        children: (T - leaves, 2) uint32 of merged nodes; parents come after their children, and the root is last.
        leaves: number of leaves; they come first, and have no place in arrays of merged nodes.
        drawn_leaves: number of splats of the scene under them.
        top: the root. T - 1, or T if nodes without a parent are to get one later, which is that root until then.
        log_size: (top + 1,) float32 feature sizes, replaced by ln(size), but no more than the parent's: the threshold
            above which the traversal does not refine the node.
        lost: (top + 1 - leaves,) float32, `picture_error`, replaced by the error cost of merged nodes, in splats.
        weight: (top + 1 - leaves,) float32, filled for merged nodes with their rarity weight.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.

    Returns:
        (top + 1,) uint32 parents; the root's is itself.
    """
    total, steps = leaves + len(children), STEPS * OCTAVES
    for block in prange(blocks):
        for node in range(total * block // blocks, total * (block + 1) // blocks):
            log_size[node] = math.log(max(log_size[node], LEAST_SIZE))
    if top == total:
        log_size[top] = ABOVE_ALL
    parent = np.empty(top + 1, np.uint32)
    parent[:] = top
    for node in range(total - 1, leaves - 1, -1):
        log_size[node] = min(log_size[node], log_size[parent[node]])
        parent[children[node - leaves, 0]] = parent[children[node - leaves, 1]] = node
    counts, step_of = np.zeros((blocks, 2, steps), np.int64), np.empty(total - leaves, np.uint16)
    for block in prange(blocks):
        for node in range(total * block // blocks, total * (block + 1) // blocks):
            if node < leaves:
                log_size[node] = min(log_size[node], log_size[parent[node]])
            step = size_step(math.exp(log_size[node]))
            counts[block, 0, step] += 1
            if node >= leaves:
                counts[block, 1, step] += 1
                step_of[node - leaves] = step
    count, inner, sums = np.zeros(steps), np.zeros(steps), np.zeros(steps)
    for block in range(blocks):
        for step in range(steps):
            count[step] += counts[block, 0, step]
            inner[step] += counts[block, 1, step]
    for slot in range(total - leaves - 1, -1, -1):  # one after the other, so that threads do not change the rounding
        sums[step_of[slot]] += lost[slot]
    drawn, rare = 0.0, np.empty(steps)
    for step in range(steps - 1, -1, -1):
        drawn += count[step]  # roughly the splats of a cut with this threshold
        rare[step] = min(1.0, drawn / (FEW * drawn_leaves))
        count[step] = max(min(drawn, float(drawn_leaves)), 1.0) ** -RARITY
    for block in prange(blocks):
        slots = total - leaves
        for slot in range(slots * block // blocks, slots * (block + 1) // blocks):
            step = step_of[slot]
            weight[slot] = count[step]
            mean = sums[step] / inner[step]
            lost[slot] = ERROR_COST * rare[step] * math.sqrt(lost[slot] / mean) if mean > 0 else 0.0
    return parent


@kernel()
def usefulness_key(useful):
    """Return the KEY_BITS highest bits of a float32 as an integer >= 0, in the order of the numbers."""
    bits = np.int64(np.float32(useful).view(np.int32))
    ordered = bits if bits >= 0 else np.int64(-0x80000000) - bits
    return (ordered + 0x80000000) >> (32 - KEY_BITS)


@kernel(i8, i8, out(u4[:]), f4[:], out(f4[:]), f4[:], out(i4[:]), i8, parallel=True)
def drop_nodes(leaves, most, parent, log_size, lost, weight, saved, blocks):
    """Drop the least useful merged nodes until `most` are left, or none can be dropped.

    Args:
        leaves: number of leaves; they come first, and have no place in arrays of merged nodes.
        most: number of merged nodes to keep, at least 1, the root.
        parent: (T,) uint32, updated for what is kept: the nearest ancestor that is kept.
        log_size, lost, weight: of `fill_usefulness_terms`; the error cost of a dropped node is added to its parent's.
        saved: (T - leaves,) int32, on entry 1 for each merged node; what is less for the root allows it that many more
            children. Updated: the number of children minus 1 of those that are kept, -1 for dropped nodes.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.
    """
    left = len(parent) - leaves
    many = slots = left - 1
    kept = np.empty(slots, np.uint32)  # the first `many`: merged nodes but the root, less `leaves`, parents first
    for slot in range(slots):
        kept[slot] = slots - 1 - slot
    keys, others = np.empty(slots, np.uint16), np.empty(slots, np.uint32)
    turn, children = ROUNDS, MOST_CHILDREN
    while left > most:  # also after ROUNDS, where nodes gained usefulness as their children were dropped
        counts = np.zeros((blocks, 1 << KEY_BITS), np.int32)
        for block in prange(blocks):
            for i in range(many * block // blocks, many * (block + 1) // blocks):
                node = kept[i]
                keys[node] = LAST_KEY
                if can_be_dropped(node, leaves, parent, saved, children):
                    key = usefulness_key(usefulness(node, leaves, parent, log_size, lost, weight, saved))
                    keys[node] = key
                    counts[block, key] += 1
        count, candidates = np.zeros(1 << KEY_BITS, np.int64), 0
        for block in range(blocks):
            for key in range(1 << KEY_BITS):
                count[key] += counts[block, key]
                candidates += counts[block, key]
        if candidates == 0:
            if children == MAX_CHILDREN:
                break
            children = min(2 * children, MAX_CHILDREN)
            continue
        wanted, threshold, below = min(max((left - most) // turn, 1), candidates), 0, 0
        while below + count[threshold] < wanted:
            below += count[threshold]
            threshold += 1
        for i in range(many - 1, -1, -1):
            node = kept[i]
            if keys[node] > threshold:
                continue
            if left <= most:
                break
            if not can_be_dropped(node, leaves, parent, saved, children):
                continue
            if usefulness_key(usefulness(node, leaves, parent, log_size, lost, weight, saved)) <= threshold:
                above = parent[node + leaves] - leaves
                saved[above] += saved[node]
                lost[above] += lost[node]
                saved[node] = -1
                left -= 1
                if above < slots:
                    keys[above] = 0  # its usefulness has changed, and is computed again when its turn comes
        left_in = np.zeros(blocks + 1, np.int64)  # of the blocks before
        for block in prange(blocks):
            here = 0
            for i in range(many * block // blocks, many * (block + 1) // blocks):
                here += saved[kept[i]] != -1
            left_in[block + 1] = here
        for block in range(blocks):
            left_in[block + 1] += left_in[block]
        for block in prange(blocks):
            after = left_in[block]
            for i in range(many * block // blocks, many * (block + 1) // blocks):
                node = kept[i]
                if saved[node] == -1:
                    continue
                # Dropped nodes keep the parent that they had, so that no thread reads what another one writes.
                while saved[parent[node + leaves] - leaves] == -1:
                    parent[node + leaves] = parent[parent[node + leaves]]
                others[after] = node
                after += 1
        many = left_in[blocks]
        kept, others = others, kept
        turn = max(turn - 1, 1)
    for block in prange(blocks):
        for leaf in range(leaves * block // blocks, leaves * (block + 1) // blocks):
            while saved[parent[leaf] - leaves] == -1:  # once for each round at most
                parent[leaf] = parent[parent[leaf]]


@kernel(inline=True)
def can_be_dropped(node, leaves, parent, saved, children):
    """Return whether merged node `leaves + node` is kept as yet, and its parent has room for its children."""
    return saved[node] > 0 and saved[parent[node + leaves] - leaves] + saved[node] < children


@kernel(inline=True)
def usefulness(node, leaves, parent, log_size, lost, weight, saved):
    """Return the usefulness of merged node `leaves + node`: span of ln(size) * (children - 1 - cost) * weight."""
    span = log_size[parent[node + leaves]] - log_size[node + leaves]
    if span > ABOVE_ALL / 2:
        span = UNKNOWN_SPAN
    return span * (np.float32(saved[node]) - lost[node]) * weight[node]


@kernel(i8, f4, u4[:], f4[:], i4[:], i4[:])
def size_ranks(leaves, highest, parent, log_size, saved, latest):
    """Return the ranks of merged nodes in the final order: size steps below the highest, above the parent's.

    Args:
        leaves, parent, log_size, saved: as for `drop_nodes`.
        highest: ln(size) of rank 0.
        latest: (leaves,) int32 rank that the leaves' parents must be below; or empty.

    Returns:
        (T - leaves,) int32, NO_RANK for dropped nodes.
    """
    total = len(parent)
    rank = np.full(total - leaves, NO_RANK, np.int32)
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
    return rank


@kernel(u4[:], i8, u4[:], i4[:], out(u4[:]), out(u4[:]), out(u2[:]))
def lay_out_children(inner, leaves, parent, saved, order, child_start, child_count):
    """Assign final indices: the root is 0, siblings are consecutive, and come in the order of their parents.

    Args:
        inner: (I,) uint32, the merged nodes that are kept, parents before their children.
        leaves: number of leaves.
        parent, saved: of `drop_nodes`.
        order: (M,) uint32, filled with the node of each final index.
        child_start, child_count: columns of a `LodTree` of M nodes, filled.

    Returns:
        (I,) uint32 final indices of `inner`.
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
    final = np.empty(len(inner), np.uint32)
    for i in range(len(inner)):
        own = inner[i] - leaves
        final[i] = index[own]
        child_count[final[i]] = saved[own] + 1
        child_start[final[i]] = start[own] - (saved[own] + 1)
    return final
