"""The rounds of the search for a cut, which refine all nodes above a threshold; and its priority queue, a heap."""

from __future__ import annotations

import numpy as np

from ...system.jit import kernel, prefetch
from .cut_arrays import (
    BASE,
    BUCKET_BITS,
    BUCKETS,
    COUNT,
    DRAWN,
    GAPS,
    INFINITE_BITS,
    LEAF,
    LOW,
    OVERFLOW,
    RUNS,
    WAITING,
    from_bits,
    is_resident,
    limit_bits,
    to_bits,
)
from .pixel_scale import INFINITE

#: Nodes ahead of the one being refined whose own record, and whose children, are fetched into the processor's cache.
#: Chosen among 8 to 24 and 6 to 12, which differ little (benchmarks/notes/cuts-and-chunks.md).
OWN_AHEAD, CHILDREN_AHEAD = 16, 6

#: Nodes of 24 bytes in a cache line of 64, rounded up.
LINE_NODES = 3

#: Least and most share to which a round lowers the threshold. The cut does not depend on them: lowering it too far
#: costs visits of nodes that are not refined, and too little costs rounds.
LEAST_STEP, MOST_STEP = 1 / 8, 0.95

#: Buckets in which pixel scales double.
OCTAVE = 1 << (23 - BUCKET_BITS)

#: Least and most power of 1 / threshold to which the number of nodes is taken to grow; -2 where splats cover surfaces.
LEAST_POWER, MOST_POWER = 0.5, 4.0

#: Share by which a threshold is lowered beyond the estimate, since a few nodes too many cost less than another round.
BEYOND = 0.98


@kernel(nogil=True)
def visit_roots(trees, stop, slots):
    """Put the resident roots into the slots; returns the bits of the largest limit."""
    nodes, views, resident, _ = trees
    node, limit, instance, _, _, pending, _, sums, tally = slots
    sums[:] = 0
    tally[:] = 0
    count, waiting = 0, 0
    largest = np.int32(0)
    for number in range(len(views)):
        if not resident[views[number].chunk_base]:
            continue
        node[count], instance[count] = 0, number
        limit[count] = limit_bits(nodes[views[number].node_base], views[number], INFINITE_BITS)
        largest = max(largest, limit[count])
        pending[waiting] = count
        waiting += limit[count] > stop.smallest
        count += 1
    slots.first[0] = count
    tally[COUNT], tally[WAITING], tally[BASE], tally[DRAWN] = count, waiting, count, count
    return largest


@kernel(nogil=True)
def refine(trees, stop, slots, threshold):
    """Refine the nodes with a limit above a threshold, in the order in which they are in memory.

    Where they come to more than the budget, the threshold is raised, to the bucket in which that happens.

    Args:
        trees: `Trees`.
        stop: `Stop`.
        slots: `Slots`; `tally` has the state, which is brought up to date.
        threshold: float32.
    """
    nodes, views, _, _ = trees
    smallest, budget = stop
    node, limit, instance, first, queue, pending, _, sums, tally = slots
    count, runs, waiting, gaps = tally[COUNT], tally[RUNS], tally[WAITING], tally[GAPS]
    low = np.int64(to_bits(threshold) >> BUCKET_BITS)
    drawn = tally[BASE]
    for bucket in range(low, BUCKETS):
        drawn += sums[bucket]
    done, ready, left = runs, runs, np.int64(0)
    for entry in range(waiting):
        at = pending[entry]
        due = limit[at] >> BUCKET_BITS >= low
        queue[ready] = at
        ready += due
        pending[left] = at
        left += not due
    while done < ready:
        at = queue[done]
        ahead = queue[min(done + OWN_AHEAD, ready - 1)]
        prefetch(nodes, views[instance[ahead]].node_base + node[ahead])
        ahead = queue[min(done + CHILDREN_AHEAD, ready - 1)]
        base = views[instance[ahead]].node_base
        start = base + np.int64(nodes[base + node[ahead]].child_start)
        for line in range(LINE_NODES):
            prefetch(nodes, start + LINE_NODES * line)
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
        if count + children >= len(node):
            tally[OVERFLOW] = 1
            return
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
    first[runs] = count
    tally[COUNT], tally[RUNS], tally[WAITING], tally[GAPS] = count, runs, left, gaps
    tally[DRAWN], tally[LOW] = drawn, low


@kernel(nogil=True)
def lowered(slots, threshold, budget):
    """Return the next threshold, at which the cut is likely to have a little more than `budget` nodes.

    Args:
        slots: `Slots`.
        threshold: float32, down to which nodes are refined; they are fewer than `budget`.
        budget: number of nodes.
    """
    # The number of nodes grows as a power of 1 / threshold, which is estimated by the last octave.
    drawn = slots.tally[DRAWN]
    before, largest = drawn, np.int32(0)
    low = np.int64(to_bits(threshold) >> BUCKET_BITS)
    for bucket in range(low, min(low + OCTAVE, BUCKETS)):
        before -= slots.sums[bucket]
    if drawn == before or threshold == INFINITE:
        # Nothing was added in the last octave; perhaps nothing is in several more.
        for entry in range(slots.tally[WAITING]):
            largest = max(largest, slots.limit[slots.pending[entry]])
        return min(from_bits(largest), threshold * np.float32(LEAST_STEP))
    power = min(MOST_POWER, max(LEAST_POWER, np.log2(drawn / max(before, 1))))
    step = BEYOND * (drawn / budget) ** (1 / power)
    return threshold * np.float32(min(MOST_STEP, max(LEAST_STEP, step)))


@kernel(inline=True)
def comes_before(node, limit, instance, a, b):
    """Return whether slot `a` is refined before `b`: by pixel scale, instance, index, the greatest first."""
    if limit[a] != limit[b]:
        return limit[a] > limit[b]
    if instance[a] != instance[b]:
        return instance[a] > instance[b]
    return node[a] > node[b]


@kernel(nogil=True)
def sift_up(node, limit, instance, heap, at):
    """Move the heap's entry at `at` up to where the heap is in order."""
    while at > 0:
        above = (at - 1) >> 1
        if not comes_before(node, limit, instance, heap[at], heap[above]):
            return
        heap[at], heap[above] = heap[above], heap[at]
        at = above


@kernel(nogil=True)
def sift_down(node, limit, instance, heap, length):
    """Move the heap's first entry down to where the heap is in order."""
    at = 0
    while True:
        child = 2 * at + 1
        if child >= length:
            return
        if child + 1 < length and comes_before(node, limit, instance, heap[child + 1], heap[child]):
            child += 1
        if not comes_before(node, limit, instance, heap[child], heap[at]):
            return
        heap[at], heap[child] = heap[child], heap[at]
        at = child
