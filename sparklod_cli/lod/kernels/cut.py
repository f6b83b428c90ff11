"""Find the budgeted cut through trees of splats: the nodes that a viewer draws."""

from __future__ import annotations

import numpy as np

from ...system.jit import kernel
from ...system.jit_types import f4, out
from .cut_arrays import (
    BASE,
    BUCKET_BITS,
    BUCKETS,
    BUDGET,
    COUNT,
    DRAWN,
    EXHAUSTED,
    FULL,
    GAPS,
    INFINITE_BITS,
    LEAF,
    LOW,
    MISSING,
    OVERFLOW,
    PIXEL,
    RUNS,
    WAITING,
    CutNodes,
    Slots,
    Stop,
    Trees,
    from_bits,
    is_resident,
    limit_bits,
    put,
    request_chunks,
)
from .pixel_scale import ZERO
from .refine import comes_before, lowered, refine, sift_down, sift_up, visit_roots

#: The first threshold without a guess, as a share of the largest root's pixel scale. The cut does not depend on it.
FIRST_STEP = np.float32(1 / 8)


@kernel(Trees, Stop, f4, out(Slots), out(f4[:]), out(CutNodes), nogil=True)
def find_cut(trees, stop, guess, slots, demand, cut):
    """Refine the node with the largest pixel scale, as long as that is above `stop.smallest` and the budget allows it.

    The cut is that of a queue ordered by (pixel scale, instance, index), the greatest first, but it is found by
    thresholds. The queue takes out a node when all that are left are at or below its *limit*, the least pixel scale on
    the path from the root to it. So all nodes with a limit above a threshold are refined, in the order in which they
    are in memory, and the threshold is lowered until their number is what the budget allows. If they are more, it is
    raised again: `slots.sums` has the number of nodes that each bucket of limits added. Only the bucket in which the
    budget ends is refined in the order of the queue. A node that would exceed the budget ends the cut whether or not
    its children are resident.

    Args:
        trees: `Trees`.
        stop: `Stop`.
        guess: float32, the first threshold, such as the last cut's, or 0; the cut does not depend on it.
        slots: `Slots`, working memory.
        demand: (chunks,) float32 of all trees, filled: the largest limit of the nodes that are, or should be, refined
            and have children in the chunk; 0 if there is none.
        cut: `CutNodes` of more than `stop.budget` nodes, filled.

    Returns:
        selected: number of nodes in the cut.
        reason: BUDGET, PIXEL, MISSING, EXHAUSTED or FULL.
        missing: number of nodes in the cut that would be refined if their children were resident, and of roots that
            are not resident.
        least: the least limit of a refined node; infinite if none was refined.
        last: the slot of the node that would have exceeded the budget, or -1.
    """
    tally = slots.tally
    largest = visit_roots(trees, stop, slots)
    threshold = guess if guess > ZERO else from_bits(min(largest, INFINITE_BITS)) * FIRST_STEP
    while True:
        threshold = max(threshold, from_bits(stop.smallest))
        refine(trees, stop, slots, threshold)
        if tally[OVERFLOW]:
            return 0, FULL, 0, ZERO, -1
        done = tally[WAITING] == 0 or tally[LOW] <= stop.smallest >> BUCKET_BITS
        if tally[DRAWN] > stop.budget or done:
            break
        threshold = lowered(slots, threshold, stop.budget)
    low = tally[LOW] if tally[DRAWN] > stop.budget else -1  # -1: nothing was refined in vain
    bucket = low
    if tally[GAPS]:
        sum_from_top(slots, low)
        bucket = stopping_bucket(trees, slots, stop.budget, low, np.int64(BUCKETS))
    while True:
        collected = collect(trees, stop, slots, demand, cut, bucket)
        selected, reason, missing, least, last = finish(trees, stop, slots, demand, cut, bucket, collected)
        if last >= 0 or reason == FULL or bucket == low:
            return selected, reason, missing, least, last
        bucket = stopping_bucket(trees, slots, stop.budget, low, bucket)


@kernel(nogil=True)
def sum_from_top(slots, low):
    """Turn `slots.sums` above a bucket into the number of nodes of the cut when all down to a bucket are refined."""
    total = slots.first[0]
    for bucket in range(BUCKETS - 1, low, -1):
        total += slots.sums[bucket]
        slots.sums[bucket] = total


@kernel(nogil=True)
def stopping_bucket(trees, slots, budget, low, below):
    """Return the next bucket in which the budget may end: that of a node whose children are missing, or else `low`.

    As in Spark, refinement also ends at a node whose children would exceed the budget but are not resident. They are in
    no sum. So the budget may end in a bucket where it does not suffice for all that the bucket adds and such children.

    Args:
        trees: `Trees`.
        slots: `Slots`, after `sum_from_top`.
        budget: number of nodes of a cut.
        low: the bucket in which resident nodes exceed the budget, -1 if they do not.
        below: only buckets below this one.
    """
    nodes, views, _, _ = trees
    node, limit, instance, first, queue, _, _, sums, tally = slots
    found = low
    for run in range(tally[RUNS]):
        if first[run] == first[run + 1]:
            at = queue[run]
            bucket = np.int64((limit[at] & ~LEAF) >> BUCKET_BITS)
            children = np.int64(nodes[views[instance[at]].node_base + node[at]].child_count)
            if found < bucket < below and sums[bucket] + children - 1 > budget:
                found = bucket
    return found


@kernel(nogil=True)
def collect(trees, stop, slots, demand, cut, low):
    """Collect the nodes of the cut when all nodes of the buckets above `low` are refined, and none of `low`.

    Args:
        trees, stop, wanted, cut: as for `find_cut`.
        slots: `Slots`; `heap` gets the slots of nodes in the bucket `low`, which are left to `finish`.
        low: the bucket in which the budget may end, -1 if it does not.

    Returns:
        number of collected nodes; number of nodes in `heap`; number of nodes whose children are missing; whether a node
        with children is too small to be refined; bits of the least limit of a refined node.
    """
    nodes, views, _, _ = trees
    smallest = stop.smallest
    node, limit, instance, first, queue, _, heap, _, tally = slots
    runs = tally[RUNS]
    demand[:] = 0
    for run in range(runs if tally[GAPS] else 0):
        at = queue[run]
        if first[run] == first[run + 1]:  # missing: no longer a leaf where the queue decides, and again one above
            limit[at] &= ~LEAF
            limit[at] |= LEAF if limit[at] >> BUCKET_BITS > low else 0
    selected, queued, missing, small = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    least = INFINITE_BITS
    # Nodes from `bottom` on go through the queue, those from `top` on are refined before that.
    bottom, top = max(np.int64(smallest) + 1, low << BUCKET_BITS), max(np.int64(smallest) + 1, (low + 1) << BUCKET_BITS)
    for run in range(-1, runs):
        start, end = np.int64(0), np.int64(first[0])
        if run >= 0:
            at = queue[run]
            bits = limit[at] & ~LEAF
            if bits >> BUCKET_BITS <= low:
                continue
            start, end = np.int64(first[run]), np.int64(first[run + 1])
            view = views[instance[at]]
            if start == end:
                record = nodes[view.node_base + node[at]]
                children = np.int64(record.child_count)
                request_chunks(demand, trees, view, np.int64(record.child_start), children, from_bits(bits))
                missing += 1
                continue
            request_chunks(demand, trees, view, np.int64(node[start]), end - start, from_bits(bits))
            least = min(least, bits)
        for at in range(start, end):
            # Branch-free where it cannot be predicted: each node is written to the cut, and stays there if it is drawn.
            bits = limit[at] & ~LEAF
            below, above = bits < bottom, bits >= top
            is_leaf = limit[at] < 0
            put(cut, selected, node[at], limit[at] if above else bits, instance[at])
            selected += below | (above & is_leaf)
            small |= below & (not is_leaf)
            if not (below | above):
                heap[queued] = at
                queued += 1
    return selected, queued, missing, small, least


@kernel(nogil=True)
def finish(trees, stop, slots, demand, cut, low, collected):
    """Add what is drawn of the last bucket to the nodes that `collect` has found.

    The nodes of that bucket go through the queue. Those that are there from the start have their own pixel scale as
    their limit, since their parents are in a larger bucket. Children of one of them are queued by their own pixel
    scale, too, with their limit kept apart. Leaves that are there from the start stay out of the queue, which is
    faster: those among them count as taken out that come before the least node that was.

    Args:
        trees, stop, slots, wanted, cut: as for `find_cut`.
        low: the bucket in which the budget may end, -1 if it does not.
        collected: result of `collect`.

    Returns:
        as `find_cut`; `last` is -1 if the budget does not end in this bucket, and there is no cut unless `low` is -1.
    """
    nodes, views, _, _ = trees
    smallest, budget = stop
    node, limit, instance, _, queue, path, heap, _, tally = slots  # path: the limit of a slot in the queue
    selected, queued, missing, small, least = collected
    missing += len(views) - tally[BASE]
    leaf_at, count = queue[tally[RUNS] :], tally[COUNT]
    length, leaves = np.int64(0), np.int64(0)
    for entry in range(queued):
        at = np.int64(heap[entry])
        if limit[at] < 0:
            put(cut, selected, node[at], limit[at] & ~LEAF, instance[at])
            leaf_at[leaves] = selected
            selected += 1
            leaves += 1
        else:
            path[at] = limit[at]
            heap[length] = at
            sift_up(node, limit, instance, heap, length)
            length += 1
    if low < 0:
        return selected, PIXEL if small else MISSING if missing else EXHAUSTED, missing, from_bits(least), -1
    drawn = selected + length
    least_at = heap[0]
    while length:
        at = heap[0]
        if comes_before(node, limit, instance, least_at, at):
            least_at = at
        view = views[instance[at]]
        base = view.node_base
        start = np.int64(nodes[base + node[at]].child_start)
        children = np.int64(nodes[base + node[at]].child_count)
        if limit[at] >> BUCKET_BITS < low:
            break
        if drawn + children - 1 > budget:  # even if they are not resident, as in Spark
            for entry in range(length):
                queued_at = heap[entry]
                put(cut, selected, node[queued_at], path[queued_at], instance[queued_at])
                selected += 1
            last = limit[least_at], instance[least_at], node[least_at]
            for entry in range(leaves):
                leaf = leaf_at[entry]
                if (cut.limit[leaf], cut.instance[leaf], cut.node[leaf]) > last:
                    cut.limit[leaf] |= LEAF
            return selected, BUDGET, missing, from_bits(least), np.int64(at)
        length -= 1
        heap[0] = heap[length]
        sift_down(node, limit, instance, heap, length)
        if children:
            request_chunks(demand, trees, view, start, children, from_bits(path[at]))
        if children == 0 or not is_resident(trees, view, start, children):
            missing += children > 0
            put(cut, selected, node[at], path[at] | LEAF, instance[at])
            selected += 1
            continue
        if count + children >= len(node):
            return 0, FULL, 0, ZERO, -1
        least = min(least, path[at])
        drawn += children - 1
        for child in range(start, start + children):
            node[count], instance[count] = child, instance[at]
            limit[count] = limit_bits(nodes[base + child], view, INFINITE_BITS) & ~LEAF
            path[count] = min(limit[count], path[at])
            if limit[count] > smallest:
                heap[length] = count
                sift_up(node, limit, instance, heap, length)
                length += 1
            else:
                put(cut, selected, node[count], path[count], instance[count])
                selected += 1
            count += 1
    return selected, BUDGET, missing, from_bits(least), -1
