"""Finds the budgeted cut through trees of splats: the nodes that a viewer draws."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .collect_cut import collect, finish
from .cut_arrays import (
    BUCKET_BITS,
    BUCKETS,
    DRAWN,
    FULL,
    GAPS,
    INFINITE_BITS,
    LEAF,
    LOW,
    OVERFLOW,
    RUNS,
    WAITING,
    from_bits,
    row_of,
)
from .pixel_scale import ZERO
from .refine import lowered, refine, visit_roots

#: The first threshold without a guess, as a share of the largest root's pixel scale. The cut does not depend on it.
FIRST_STEP = np.float32(1 / 8)


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
        slots: `Slots` of one part, working memory.
        wanted: (1, chunks) float32 of all trees, filled: the largest limit of the nodes that are, or should be, refined
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
    row = row_of(slots, 0)
    tally = row.tally
    largest = visit_roots(trees, stop, row)
    threshold = guess if guess > ZERO else from_bits(min(largest, INFINITE_BITS)) * FIRST_STEP
    while True:
        threshold = max(threshold, from_bits(stop.smallest))
        refine(trees, stop, row, threshold, stop.budget)
        if tally[OVERFLOW]:
            return 0, FULL, 0, ZERO, -1
        done = tally[WAITING] == 0 or tally[LOW] <= stop.smallest >> BUCKET_BITS
        if tally[DRAWN] > stop.budget or done:
            break
        threshold = lowered(slots, threshold, stop.budget)
    low = tally[LOW] if tally[DRAWN] > stop.budget else -1  # -1: nothing was refined in vain
    bucket = low
    if tally[GAPS]:
        sum_from_top(row, low)
        bucket = stopping_bucket(trees, row, stop.budget, low, np.int64(BUCKETS))
    while True:
        collect(trees, stop, row, wanted[0], cut, 0, bucket)
        selected, reason, missing, least, last = finish(trees, stop, slots, wanted, cut, bucket)
        if last >= 0 or reason == FULL or bucket == low:
            return selected, reason, missing, least, last
        bucket = stopping_bucket(trees, row, stop.budget, low, bucket)


@kernel(nogil=True)
def sum_from_top(slots, low):
    """Turns `slots.sums` above a bucket into the number of nodes of the cut when all down to a bucket are refined."""
    total = slots.first[0]
    for bucket in range(BUCKETS - 1, low, -1):
        total += slots.sums[bucket]
        slots.sums[bucket] = total


@kernel(nogil=True)
def stopping_bucket(trees, slots, budget, low, below):
    """The next bucket in which the budget may end: that of a node whose children are missing, or else `low`.

    As in Spark, refinement also ends at a node whose children would exceed the budget but are not resident. They are in
    no sum. So the budget may end in a bucket where it does not suffice for all that the bucket adds and such children.

    Args:
        trees: `Trees`.
        slots: `Slots` of the only part, after `sum_from_top`.
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
