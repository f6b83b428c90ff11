"""Finds the budgeted cut through trees of splats: the nodes that a viewer draws."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .collect_cut import collect_cut
from .cut_arrays import BUCKET_BITS, BUCKETS, FULL, INFINITE_BITS, LEAF, from_bits, is_resident, limit_bits, to_bits
from .pixel_scale import ZERO

#: The first threshold without a guess, as a share of the largest root's pixel scale; least and most share to which a
#: round lowers the threshold. The cut does not depend on them: lowering it too far costs visits of nodes that are not
#: refined, and too little costs rounds.
FIRST_STEP, LEAST_STEP, MOST_STEP = np.float32(1 / 8), 1 / 8, 0.95


@kernel(nogil=True)
def find_cut(trees, stop, guess, slots, wanted, cut):
    """Refines the node with the largest pixel scale, as long as that is above `stop.smallest` and the budget allows it.

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
        wanted: (chunks,) float32 of all trees, filled: the largest limit of the nodes that are, or should be, refined
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
    nodes, views, resident, _ = trees
    smallest, budget = stop
    node, limit, instance, first, queue, pending, _, sums = slots
    sums[:] = 0
    count, runs, ready, waiting, gaps = 0, 0, 0, 0, 0
    largest = np.int32(0)
    if len(views) > len(node):
        return 0, FULL, 0, ZERO, -1
    for number in range(len(views)):
        if not resident[views[number].chunk_base]:
            continue
        node[count], instance[count] = 0, number
        limit[count] = limit_bits(nodes[views[number].node_base], views[number], INFINITE_BITS)
        largest = max(largest, limit[count])
        pending[waiting] = count
        waiting += limit[count] > smallest
        count += 1
    drawn = np.int64(count)
    threshold = guess if guess > ZERO else from_bits(largest) * FIRST_STEP
    while True:
        threshold = max(threshold, from_bits(smallest))
        low = to_bits(threshold) >> BUCKET_BITS
        done, ready, left = runs, runs, 0
        for entry in range(waiting):
            at = pending[entry]
            due = limit[at] >> BUCKET_BITS >= low
            queue[ready] = at
            ready += due
            pending[left] = at
            left += not due
        while done < ready:
            at = queue[done]
            done += 1
            above = limit[at]
            bucket = above >> BUCKET_BITS
            if bucket < low:  # the threshold has been raised since
                pending[left] = at
                left += 1
                continue
            queue[runs] = at
            first[runs] = count
            runs += 1
            number = instance[at]
            view = views[number]
            base = view.node_base
            start = np.int64(nodes[base + node[at]].child_start)
            children = np.int64(nodes[base + node[at]].child_count)
            if not is_resident(trees, view, start, children):
                limit[at] |= LEAF  # from here on a leaf
                gaps += 1
                continue
            if count + children > len(node):
                return 0, FULL, 0, ZERO, -1
            drawn += children - 1
            sums[bucket] += children - 1
            while drawn - sums[low] > budget:
                drawn -= sums[low]
                low += 1
            for child in range(start, start + children):
                own = limit_bits(nodes[base + child], view, above)
                node[count] = child
                limit[count] = own
                instance[count] = number
                # Branch-free, as the branches could not be predicted.
                can_refine = own > smallest
                due = own >> BUCKET_BITS >= low
                queue[ready] = count
                ready += can_refine & due
                pending[left] = count
                left += can_refine & (not due)
                count += 1
        waiting = left
        if drawn > budget or waiting == 0 or low <= smallest >> BUCKET_BITS:
            break
        largest = np.int32(0)
        for entry in range(waiting):
            largest = max(largest, limit[pending[entry]])
        # Where splats cover surfaces, their number is proportional to the threshold to the power of -2.
        threshold *= np.float32(max(LEAST_STEP, min(MOST_STEP, np.sqrt(drawn / budget))))
        threshold = min(threshold, from_bits(largest))
    first[runs] = count
    if drawn <= budget:
        low = -1  # nothing was refined in vain
    # Literals would be compiled as types of their own.
    count, runs, low = np.int64(count), np.int64(runs), np.int64(low)
    bucket = low
    if gaps:
        sum_from_top(slots, low)
        bucket = stopping_bucket(trees, slots, budget, runs, low, np.int64(BUCKETS))
    while True:
        selected, reason, missing, least, last = collect_cut(trees, stop, slots, wanted, cut, count, runs, bucket)
        if last >= 0 or reason == FULL or bucket == low:
            return selected, reason, missing, least, last
        bucket = stopping_bucket(trees, slots, budget, runs, low, bucket)


@kernel(nogil=True)
def sum_from_top(slots, low):
    """Turns `slots.sums` above a bucket into the number of nodes of the cut when all down to a bucket are refined."""
    total = slots.first[0]
    for bucket in range(BUCKETS - 1, low, -1):
        total += slots.sums[bucket]
        slots.sums[bucket] = total


@kernel(nogil=True)
def stopping_bucket(trees, slots, budget, runs, low, below):
    """The next bucket in which the budget may end: that of a node whose children are missing, or else `low`.

    As in Spark, refinement also ends at a node whose children would exceed the budget but are not resident. They are in
    no sum. So the budget may end in a bucket where it does not suffice for all that the bucket adds and such children.

    Args:
        trees: `Trees`.
        slots: `Slots`, after `sum_from_top`.
        budget: number of nodes of a cut.
        runs: number of refined nodes in `slots.queue`.
        low: the bucket in which resident nodes exceed the budget, -1 if they do not.
        below: only buckets below this one.
    """
    nodes, views, _, _ = trees
    node, limit, instance, first, queue, _, _, sums = slots
    found = low
    for run in range(runs):
        if first[run] == first[run + 1]:
            at = queue[run]
            bucket = np.int64((limit[at] & ~LEAF) >> BUCKET_BITS)
            children = np.int64(nodes[views[instance[at]].node_base + node[at]].child_count)
            if found < bucket < below and sums[bucket] + children - 1 > budget:
                found = bucket
    return found
