"""Finds the budgeted cut through trees of splats: which nodes a viewer draws."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .pixel_scale import ZERO, pixel_scale
from .queue import comes_before, rise, sink

#: Nodes of a chunk, as a power of 2.
CHUNK_BITS = 16

#: Buckets of pixel scales: the upper half of a float32, so each is at most 0.8 % wide and all numbers have one.
BUCKET_BITS = 16
BUCKETS = 1 << (31 - BUCKET_BITS)

#: The first threshold, of the largest root's pixel scale, and how far it may be lowered at once. The result does not
#: depend on these: too far costs nodes that are looked at in vain, not far enough costs rounds.
FIRST_STEP, LEAST_STEP, MOST_STEP = np.float32(1 / 8), 1 / 8, 0.95

#: Pixel scales are compared as the bits of a float32, which order as the numbers do. NaN counts as infinity; in Spark,
#: too, it is the largest. A node without children has the sign bit as well: it is less than any threshold.
INFINITE = np.float32(np.inf).view(np.int32)
LEAF = np.int32(-(1 << 31))

#: How a cut came to its end; FULL: `items` is too short, and the cut is none.
BUDGET, PIXEL, MISSING, EXHAUSTED, FULL = 0, 1, 2, 3, 4


@kernel(inline=True)
def bits_of(value):
    """The bits of a float32 >= 0 as int32; NaN may have either sign."""
    return np.float32(value).view(np.int32) & ~LEAF


@kernel(inline=True)
def number_of(bits):
    """The float32 of which these are the bits, without the mark of a leaf."""
    return np.int32(bits & ~LEAF).view(np.float32)


@kernel(inline=True)
def limit_of(node, view, above):
    """The bits of the least pixel scale on the way from the root to a node; of `above` for its parent."""
    limit = min(bits_of(pixel_scale(node, view)), above)
    return limit if node.child_count else limit | LEAF


@kernel(nogil=True)
def find_cut(
    nodes,
    views,
    resident,
    smallest,
    budget,
    guess,
    node,
    limit,
    instance,
    first,
    queue,
    pending,
    heap,
    sums,
    wanted,
    cut,
):
    """Divides the node of the largest pixel scale, as long as there is one above `smallest` and the budget allows it.

    The same cut as that of one queue ordered by (pixel scale, instance, index), the greatest first, but found by
    thresholds. In the queue a node comes up when all that are left are at or under its *limit*, the least pixel scale
    on the way to it from the root. So all nodes of a limit above some threshold are divided, in the order in which they
    lie in memory, and the threshold is lowered until they are as many as the budget allows. Where they are more it
    rises again: `sums` tells of each bucket of limits by how much dividing its nodes adds. Only the bucket in which the
    budget ends is divided in the order of the queue.

    What has been looked at fills *slots*: of roots, then of the children of each node that was divided, run after run.

    Args:
        nodes: `NODE` of all trees, one after the other.
        views: (instances,) `VIEW`.
        resident: a bool for each chunk of all trees: its nodes are there. Nodes with children that are not there are
            not divided.
        smallest: bits of a pixel scale; nodes of it are not divided.
        budget: how many nodes may be drawn; at least one an instance.
        guess: the first threshold, such as the last cut's; the result does not depend on it. 0 for none.
        node: (slots,) uint32, to work with: the index in its tree.
        limit: (slots,) int32, to work with: see `limit_of`.
        instance: (slots,) uint16, to work with.
        first: (slots + 1,) int32 to work with: where the children of a divided node begin.
        queue: (slots,) int32 to work with: slots that were divided, then those that will be.
        pending: (slots,) int32 to work with: slots under the threshold.
        heap: (slots,) int32 to work with.
        sums: (BUCKETS,) int32 to work with.
        wanted: (chunks,) float32, filled: for each chunk of all trees the largest limit of the nodes with children in
            it that are divided or should be; 0 if there is none.
        cut: three arrays like `node`, `limit` and `instance`, longer than the cut can be, filled: its nodes; the mark
            of a leaf is on those that the queue took out, which are not all leaves.

    Returns:
        selected: nodes of the cut.
        reason: BUDGET, PIXEL, MISSING, EXHAUSTED or FULL.
        missing: nodes of the cut that would be divided if their children were there, and roots that are not there.
        least: the least limit of a node that was divided; infinite if none was.
        stop: the slot that would have exceeded the budget, -1 if none did.
    """
    sums[:] = 0
    count, runs, ready, waiting = 0, 0, 0, 0
    largest = np.int32(0)
    if len(views) > len(node):
        return 0, FULL, 0, ZERO, -1
    for number in range(len(views)):
        if not resident[views[number].chunk_base]:
            continue
        node[count], instance[count] = 0, number
        limit[count] = limit_of(nodes[views[number].node_base], views[number], INFINITE)
        largest = max(largest, limit[count])
        pending[waiting] = count
        waiting += limit[count] > smallest
        count += 1
    drawn = np.int64(count)
    threshold = guess if guess > ZERO else number_of(largest) * FIRST_STEP
    while True:
        threshold = max(threshold, number_of(smallest))
        low = bits_of(threshold) >> BUCKET_BITS
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
            if bucket < low:  # which has risen
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
            if not is_resident(resident, view, start, children):
                limit[at] |= LEAF  # as one without children
                continue
            if count + children > len(node):
                return 0, FULL, 0, ZERO, -1
            drawn += children - 1
            sums[bucket] += children - 1
            while drawn - sums[low] > budget:
                drawn -= sums[low]
                low += 1
            for child in range(start, start + children):
                own = limit_of(nodes[base + child], view, above)
                node[count] = child
                limit[count] = own
                instance[count] = number
                # Without branches, which nobody could predict.
                divisible = own > smallest
                due = own >> BUCKET_BITS >= low
                queue[ready] = count
                ready += divisible & due
                pending[left] = count
                left += divisible & (not due)
                count += 1
        waiting = left
        if drawn > budget or waiting == 0 or low <= smallest >> BUCKET_BITS:
            break
        largest = np.int32(0)
        for entry in range(waiting):
            largest = max(largest, limit[pending[entry]])
        # Where splats cover surfaces, their number goes with the threshold to the power of -2.
        threshold *= np.float32(max(LEAST_STEP, min(MOST_STEP, np.sqrt(drawn / budget))))
        threshold = min(threshold, number_of(largest))
    first[runs] = count
    if drawn <= budget:
        low = -1  # all that were divided stay so
    return finish(
        nodes,
        views,
        resident,
        smallest,
        budget,
        node,
        limit,
        instance,
        first,
        queue,
        heap,
        pending,
        wanted,
        cut,
        np.int64(count),  # never literals, for which it would be compiled as well
        np.int64(runs),
        np.int64(low),
    )


@kernel(inline=True)
def is_resident(resident, view, start, children):
    """Whether children are there; they are in as many as two chunks."""
    last = start + children - 1
    return resident[view.chunk_base + (start >> CHUNK_BITS)] and resident[view.chunk_base + (last >> CHUNK_BITS)]


@kernel(inline=True)
def want(wanted, view, start, children, limit):
    """Notes the chunks of children, as wanted as their parent is."""
    for chunk in (start >> CHUNK_BITS, (start + children - 1) >> CHUNK_BITS):
        at = view.chunk_base + chunk
        wanted[at] = max(wanted[at], limit)


@kernel(inline=True)
def draw(cut, at, node, limit, instance):
    """Writes a node of the cut."""
    cut[0][at], cut[1][at], cut[2][at] = node, limit, instance


@kernel(nogil=True)
def finish(
    nodes,
    views,
    resident,
    smallest,
    budget,
    node,
    limit,
    instance,
    first,
    queue,
    heap,
    path,
    wanted,
    cut,
    count,
    runs,
    low,
):
    """Collects the cut: what is left when nodes of the buckets above `low` are divided, and of `low` some.

    Those of that bucket go through the queue. One that waits there from the start has its own pixel scale as its limit,
    since its parent was in a larger bucket; a child of one of them gets its own, too, which orders the queue, and its
    limit in `path`. Leaves that are there from the start stay out of the queue, which is quicker: of them, those count
    as taken out that come before the least of what came up.

    Args:
        path: (slots,) int32, to work with: the limit of a slot in the queue.
        low: the bucket in which the budget ends, -1 if it does not.
        count: of slots.
        runs: of nodes in `queue`.
        rest: as `find_cut`.

    Returns:
        as `find_cut`.
    """
    wanted[:] = 0
    for run in range(runs):
        at = queue[run]
        if first[run] == first[run + 1] and (limit[at] & ~LEAF) >> BUCKET_BITS <= low:
            limit[at] &= ~LEAF
    selected, length, leaves, missing, small = 0, 0, 0, len(views) - first[0], 0
    least = INFINITE
    # Bits from which on a node goes through the queue, and is taken out of it before all that do.
    bottom, top = max(smallest + 1, low << BUCKET_BITS), max(smallest + 1, (low + 1) << BUCKET_BITS)
    for run in range(-1, runs):
        begin, end = 0, first[0]
        if run >= 0:
            at = queue[run]
            bits = limit[at] & ~LEAF
            if bits >> BUCKET_BITS <= low:
                continue
            view = views[instance[at]]
            begin, end = first[run], first[run + 1]
            record = nodes[view.node_base + node[at]]
            want(wanted, view, np.int64(record.child_start), np.int64(record.child_count), number_of(bits))
            if begin == end:
                missing += 1
                continue
            least = min(least, bits)
        for at in range(begin, end):
            # Without branches again: a slot is written, and kept if it is drawn or waits.
            bits = limit[at] & ~LEAF
            below, above = bits < bottom, bits >= top
            draw(cut, selected, node[at], limit[at] if above else bits, instance[at])
            undivided = limit[at] < 0
            queued = (not below) & (not above)
            queue[runs + leaves] = selected
            leaves += queued & undivided
            selected += below | undivided
            heap[length] = at
            length += queued & (not undivided)
            small |= below & (not undivided)
    if low < 0:
        return selected, PIXEL if small else MISSING if missing else EXHAUSTED, missing, number_of(least), -1
    for entry in range(length):
        at = heap[entry]
        path[at] = limit[at]
    for at in range(length):
        rise(node, limit, instance, heap, at)
    drawn = np.int64(selected + length)
    least_at = heap[0]
    while length:
        at = heap[0]
        if comes_before(node, limit, instance, least_at, at):
            least_at = at
        view = views[instance[at]]
        base = view.node_base
        start = np.int64(nodes[base + node[at]].child_start)
        children = np.int64(nodes[base + node[at]].child_count)
        there = children > 0 and is_resident(resident, view, start, children)
        if there and drawn + children - 1 > budget:
            for entry in range(length):
                waits = heap[entry]
                draw(cut, selected, node[waits], path[waits], instance[waits])
                selected += 1
            last = limit[least_at], instance[least_at], node[least_at]
            for entry in range(runs, runs + leaves):
                leaf = queue[entry]
                if (cut[1][leaf], cut[2][leaf], cut[0][leaf]) > last:
                    cut[1][leaf] |= LEAF
            return selected, BUDGET, missing, number_of(least), at
        length -= 1
        heap[0] = heap[length]
        sink(node, limit, instance, heap, length)
        if children:
            want(wanted, view, start, children, number_of(path[at]))
        if not there:
            missing += children > 0
            draw(cut, selected, node[at], path[at] | LEAF, instance[at])
            selected += 1
            continue
        if count + children > len(node):
            return 0, FULL, 0, ZERO, -1
        least = min(least, path[at])
        drawn += children - 1
        for child in range(start, start + children):
            node[count], instance[count] = child, instance[at]
            limit[count] = limit_of(nodes[base + child], view, INFINITE) & ~LEAF
            path[count] = min(limit[count], path[at])
            if limit[count] > smallest:
                heap[length] = count
                rise(node, limit, instance, heap, length)
                length += 1
            else:
                draw(cut, selected, node[count], path[count], instance[count])
                selected += 1
            count += 1
    return selected, BUDGET, missing, number_of(least), -1
