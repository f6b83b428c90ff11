"""The second half of finding a cut: collects it from the nodes that have been visited."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .cut_arrays import (
    ABSENT,
    BASE,
    BEGIN,
    BUCKET_BITS,
    BUDGET,
    COUNT,
    EXHAUSTED,
    FULL,
    GAPS,
    INFINITE_BITS,
    LEAF,
    LEAST,
    MISSING,
    PIXEL,
    QUEUED,
    RUNS,
    SELECTED,
    SMALL,
    from_bits,
    is_resident,
    limit_bits,
    put,
    request_chunks,
    row_of,
)
from .pixel_scale import ZERO
from .queue import comes_before, sift_down, sift_up


@kernel(nogil=True)
def collect(trees, stop, slots, wanted, cut, begin, low):
    """Collects what a part has in the cut when all nodes of the buckets above `low` are refined, and none of `low`.

    The nodes of that bucket are left to `finish`. `slots.tally` says what was found.

    Args:
        trees: `Trees`.
        stop: `Stop`.
        slots: `Slots` of the part; `heap` gets the slots of nodes in the bucket `low`.
        wanted: (chunks,) float32 of the part, filled.
        cut: `CutNodes`, filled from `begin` on.
        begin: the index of the part's first node in the cut.
        low: the bucket in which the budget may end, -1 if it does not.
    """
    nodes, views, _, _ = trees
    smallest = stop.smallest
    node, limit, instance, first, queue, _, heap, _, tally = slots
    runs = tally[RUNS]
    wanted[:] = 0
    for run in range(runs if tally[GAPS] else 0):
        at = queue[run]
        if first[run] == first[run + 1]:  # missing: no longer a leaf where the queue decides, and again one above
            limit[at] &= ~LEAF
            limit[at] |= LEAF if limit[at] >> BUCKET_BITS > low else 0
    selected, queued, missing, small = np.int64(begin), np.int64(0), np.int64(0), np.int64(0)
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
                request_chunks(wanted, trees, view, np.int64(record.child_start), children, from_bits(bits))
                missing += 1
                continue
            request_chunks(wanted, trees, view, np.int64(node[start]), end - start, from_bits(bits))
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
    tally[SELECTED], tally[QUEUED], tally[ABSENT] = selected - begin, queued, missing
    tally[SMALL], tally[LEAST] = small, least


@kernel(nogil=True)
def finish(trees, stop, slots, wanted, cut, low):
    """Adds what is drawn of the last bucket to the nodes that all parts have collected.

    The nodes of that bucket go through the queue. Those that are there from the start have their own pixel scale as
    their limit, since their parents are in a larger bucket. Children of one of them are queued by their own pixel
    scale, too, with their limit kept apart. Leaves that are there from the start stay out of the queue, which is
    faster: those among them count as taken out that come before the least node that was.

    Args:
        trees, stop, cut: as for `find_cut`.
        slots: `Slots` of all parts, after `collect`; those of the first part are overwritten.
        wanted: (parts, chunks) float32 of all parts; the first row gets what the queue wants.
        low: the bucket in which the budget may end, -1 if it does not.

    Returns:
        as `find_cut`; `last` is -1 if the budget does not end in this bucket, and there is no cut unless `low` is -1.
    """
    nodes, views, _, _ = trees
    smallest, budget = stop
    row = row_of(slots, 0)
    node, limit, instance, _, _, path, heap, _, tally = row  # path: the limit of a slot in the queue
    leaf_at = row.queue[tally[RUNS] :]
    count, missing, small, least = tally[COUNT], np.int64(len(views)), np.int64(0), INFINITE_BITS
    selected = close_gaps(slots.tally, cut)
    length, leaves, roots = np.int64(0), np.int64(0), np.int64(0)
    for part in range(len(slots.tally)):
        other = row_of(slots, part)
        missing += other.tally[ABSENT]
        small |= other.tally[SMALL]
        least = min(least, np.int32(other.tally[LEAST]))
        roots += other.tally[BASE]
        for entry in range(other.tally[QUEUED]):
            at = np.int64(other.heap[entry])
            if part:
                if count + 1 >= len(node):
                    return 0, FULL, 0, ZERO, -1
                node[count], limit[count], instance[count] = other.node[at], other.limit[at], other.instance[at]
                at = count
                count += 1
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
    missing -= roots
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
            request_chunks(wanted[0], trees, view, start, children, from_bits(path[at]))
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


@kernel(nogil=True)
def close_gaps(tally, cut):
    """Moves what the parts have collected together, to the beginning of the cut; returns the number of nodes.

    Args:
        tally: `Slots.tally` of all parts.
        cut: `CutNodes`; between the nodes of the parts is room for those that they left to the queue.
    """
    selected = np.int64(0)
    for part in range(len(tally)):
        begin, own = tally[part, BEGIN], tally[part, SELECTED]
        for entry in range(min(begin - selected, own)):
            last = begin + own - 1 - entry
            put(cut, selected + entry, cut.node[last], cut.limit[last], cut.instance[last])
        selected += own
    return selected
