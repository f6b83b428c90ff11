"""Find the budgeted cut through trees of splats: the nodes that a viewer draws."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...system.jit import b1, f4, fields, i4, i8, kernel, out, prefetch, u2, u4
from .pixel_scale import INFINITE, NODES, VIEWS, ZERO, pixel_scale

#: Buckets of pixel scales: the upper half of a float32's bits. A bucket is at most 0.8 % wide, and any number has one.
BUCKET_BITS = 16
BUCKETS = 1 << (31 - BUCKET_BITS)

#: Pixel scales are compared as the bits of a float32 >= 0, whose order is that of the numbers. NaN is the largest, as
#: in Spark. The sign bit marks leaves, which makes them smaller than any threshold.
INFINITE_BITS = INFINITE.view(np.int32)
LEAF = np.int32(-(1 << 31))

#: Reasons why a cut has no more nodes. FULL: the slots did not suffice, and there is no cut.
BUDGET, PIXEL, MISSING, EXHAUSTED, FULL = 0, 1, 2, 3, 4

#: Entries of `Slots.tally`: slots in use; refined nodes; pending ones; roots; nodes of the cut once all of bucket LOW
#: and above are refined; LOW itself; refined nodes whose children are missing; whether the slots did not suffice.
COUNT, RUNS, WAITING, BASE, DRAWN, LOW, GAPS, OVERFLOW = range(8)
TALLIES = 8


@fields(NODES, VIEWS, b1[:], i8)
class Trees(NamedTuple):
    """Instances of trees as one camera sees them."""

    nodes: Any  # `NODE` of all trees, one after the other
    views: Any  # (instances,) `VIEW`
    resident: Any  # (chunks,) bool, of all trees: the chunk is loaded. A node is not refined unless its children are.
    chunk_bits: Any  # a chunk has 2 ** chunk_bits nodes


@fields(i4, i8)
class Stop(NamedTuple):
    """Limits of refinement."""

    smallest: Any  # int32 bits of a pixel scale; nodes up to it are not refined
    budget: Any  # int64, number of nodes of a cut; at least one for each instance


@fields(u4[:], i4[:], u2[:])
class CutNodes(NamedTuple):
    """The nodes of a cut."""

    node: Any  # uint32 indices in their trees
    # int32 bits of their limits, see `find_cut`; LEAF marks nodes that the queue took out, which are not all leaves
    limit: Any
    instance: Any  # uint16


@fields(u4[:], i4[:], u2[:], i4[:], i4[:], i4[:], i4[:], i4[:], i8[:])
class Slots(NamedTuple):
    """Working memory for visited nodes: the roots, then the children of each refined node, run by run."""

    node: Any  # (slots,) uint32 index in its tree
    limit: Any  # (slots,) int32, see `limit_bits`
    instance: Any  # (slots,) uint16
    first: Any  # (slots,) int32, the first slot of each run
    queue: Any  # (slots,) int32 refined slots, one for each run, then slots to refine
    pending: Any  # (slots,) int32 slots below the threshold
    heap: Any  # (slots,) int32
    sums: Any  # (BUCKETS,) int32, for each bucket of limits the number of nodes that refining its nodes adds to the cut
    tally: Any  # (TALLIES,) int64, see COUNT


@kernel(inline=True)
def to_bits(value):
    """Return the bits of a float32 >= 0 as int32; NaN may have either sign."""
    return np.float32(value).view(np.int32) & ~LEAF


@kernel(inline=True)
def from_bits(bits):
    """Return the float32 of these bits, without the mark of a leaf."""
    return np.int32(bits & ~LEAF).view(np.float32)


@kernel(inline=True)
def limit_bits(node, view, above):
    """Return the bits of a node's limit, the least pixel scale from the root to it; `above` are those of its parent."""
    limit = min(to_bits(pixel_scale(node, view)), above)
    return limit if node.child_count else limit | LEAF


@kernel(inline=True)
def is_resident(trees, view, start, children):
    """Return whether children are resident; they are in one chunk or two."""
    last = start + children - 1
    return (
        trees.resident[view.chunk_base + (start >> trees.chunk_bits)]
        and trees.resident[view.chunk_base + (last >> trees.chunk_bits)]
    )


@kernel(inline=True)
def request_chunks(wanted, trees, view, start, children, limit):
    """Raise the priority of the chunks of a node's children to the node's limit."""
    for chunk in (start >> trees.chunk_bits, (start + children - 1) >> trees.chunk_bits):
        at = view.chunk_base + chunk
        wanted[at] = max(wanted[at], limit)


@kernel(inline=True)
def put(cut, at, node, limit, instance):
    """Write a node of the cut."""
    cut.node[at], cut.limit[at], cut.instance[at] = node, limit, instance


#: The first threshold without a guess, as a share of the largest root's pixel scale. The cut does not depend on it.
FIRST_STEP = np.float32(1 / 8)


@kernel(Trees, Stop, f4, out(Slots), out(f4[:]), out(CutNodes), returns=(i8, i8, i8, f4, i8))
def find_cut(trees, stop, guess, slots, demand, cut):
    """Find the cut: refine the node with the largest pixel scale while it is above `stop.smallest` and within budget.

    The cut is that of a queue ordered by (pixel scale, instance, index), the greatest first, but it is found by
    thresholds. The queue takes out a node once all others in it are at or below its *limit*, the least pixel scale on
    the path from the root to it. So all nodes with a limit above a threshold are refined, in memory order, and the
    threshold is lowered until the budget is used up. If there are too many nodes, the threshold is raised again:
    `slots.sums` has the number of nodes that each bucket of limits added. Only the bucket in which the budget ends is
    refined in the order of the queue. A node that would exceed the budget ends the cut, even if its children are not
    resident.

    Args:
        guess: the first threshold, such as the last cut's, or 0; the cut does not depend on it.
        demand: (chunks,) of all trees, filled with the largest limit of the nodes with children in the chunk that are
            refined, or would be if these were resident; 0 without such nodes.
        cut: room for more than `stop.budget` nodes, filled.

    Returns:
        selected: number of nodes in the cut.
        reason: BUDGET, PIXEL, MISSING, EXHAUSTED or FULL.
        missing: number of roots that are not resident, and of nodes in the cut whose children would be refined if
            resident.
        least: the least limit of a refined node; infinite if none was refined.
        last: the slot of the node that would have exceeded the budget; -1 for none.
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
    low = tally[LOW] if tally[DRAWN] > stop.budget else -1  # -1: the budget suffices for all refined nodes
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


@kernel()
def sum_from_top(slots, low):
    """Replace `slots.sums` above bucket `low` by the size of the cut that refines this bucket and all larger ones."""
    total = slots.first[0]
    for bucket in range(BUCKETS - 1, low, -1):
        total += slots.sums[bucket]
        slots.sums[bucket] = total


@kernel()
def stopping_bucket(trees, slots, budget, low, below):
    """Return the next bucket below `below` in which the budget may end: that of a node with missing children, or `low`.

    As in Spark, refinement also ends at a node whose children would exceed the budget but are not resident. No sum
    contains such children. So the budget may end in a bucket where it does not suffice for the sum and these children.
    `slots` are those of `sum_from_top`; resident nodes exceed the budget in bucket `low`, -1 if they do not.
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


@kernel()
def collect(trees, stop, slots, demand, cut, low):
    """Collect the nodes of the cut that refines the buckets above `low`, but not `low` itself.

    `low` is the bucket in which the budget may end, -1 if it suffices; fills `slots.heap` with the slots of the nodes
    of this bucket, for `finish`.

    Returns:
        numbers of collected nodes, of nodes in `heap`, and of nodes whose children are missing; whether a node
        with children is too small to be refined; bits of the least limit of a refined node.
    """
    nodes, views, _, _ = trees
    smallest = stop.smallest
    node, limit, instance, first, queue, _, heap, _, tally = slots
    runs = tally[RUNS]
    demand[:] = 0
    for run in range(runs if tally[GAPS] else 0):
        at = queue[run]
        if first[run] == first[run + 1]:  # children missing: marked as a leaf above `low`, where no queue decides
            limit[at] &= ~LEAF
            limit[at] |= LEAF if limit[at] >> BUCKET_BITS > low else 0
    selected, queued, missing, small = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    least = INFINITE_BITS
    # Nodes from `bottom` on go through the queue, nodes from `top` on are refined before.
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
            # Without unpredictable branches: each node is written to the cut, and overwritten unless it is drawn.
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


@kernel()
def finish(trees, stop, slots, demand, cut, low, collected):
    """Add the nodes of bucket `low`, refined in the order of the queue, to the nodes of `collect`.

    The limits of the initial nodes of the bucket are their own pixel scales, since their parents are in a larger
    bucket. Their children are queued by their own pixel scales, too; `slots.pending` has their limits. Initial leaves
    stay out of the queue, which is faster: the leaves that come before the least node taken out count as taken out,
    too.

    Args:
        collected: result of `collect`.

    Returns:
        as `find_cut`; if `last` is -1, the budget does not end in this bucket, and there is no cut unless `low` is -1.
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


#: Nodes ahead of the one being refined whose own record, and whose children, are fetched into the processor's cache.
#: Chosen among 8 to 24 and 6 to 12, which differ little (benchmarks/notes/cuts-and-chunks.md).
OWN_AHEAD, CHILDREN_AHEAD = 16, 6

#: Nodes of 24 bytes in a cache line of 64, rounded up.
LINE_NODES = 3

#: Least and largest factor by which a round lowers the threshold. The cut does not depend on them: a smaller factor
#: costs visits of nodes that are not refined, a larger one costs rounds.
LEAST_STEP, MOST_STEP = 1 / 8, 0.95

#: Number of buckets over which pixel scales double.
OCTAVE = 1 << (23 - BUCKET_BITS)

#: Bounds of the estimated power of 1 / threshold with which the number of nodes grows; 2 where splats cover surfaces.
LEAST_POWER, MOST_POWER = 0.5, 4.0

#: Further factor of a lowered threshold, since a few nodes too many cost less than another round.
BEYOND = 0.98


@kernel()
def visit_roots(trees, stop, slots):
    """Put the resident roots into the slots; return the bits of the largest limit."""
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


@kernel()
def refine(trees, stop, slots, threshold):
    """Refine the nodes with a limit above a threshold, in memory order; update `slots.tally`.

    If the nodes exceed the budget, the threshold rises to the bucket in which the budget ends.
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
        if bucket < low:  # the threshold has risen since
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
            # Branch-free, as branches would be unpredictable.
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


@kernel()
def lowered(slots, threshold, budget):
    """Return the next threshold, whose cut probably has slightly more than `budget` nodes.

    The cut of the last threshold, `threshold`, has fewer.
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


@kernel()
def sift_up(node, limit, instance, heap, at):
    """Move the heap's entry at `at` up to restore the order of the heap."""
    while at > 0:
        above = (at - 1) >> 1
        if not comes_before(node, limit, instance, heap[at], heap[above]):
            return
        heap[at], heap[above] = heap[above], heap[at]
        at = above


@kernel()
def sift_down(node, limit, instance, heap, length):
    """Move the heap's first entry down to restore the order of the heap."""
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
