"""The second half of `find_cut`: collects the cut from the nodes that have been visited."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .cut_arrays import (
    BUCKET_BITS,
    BUDGET,
    EXHAUSTED,
    FULL,
    INFINITE_BITS,
    LEAF,
    MISSING,
    PIXEL,
    from_bits,
    is_resident,
    limit_bits,
    put,
    request_chunks,
)
from .pixel_scale import ZERO
from .queue import comes_before, sift_down, sift_up


@kernel(nogil=True)
def collect_cut(trees, stop, slots, wanted, cut, count, runs, low):
    """Collects the cut that is left when all nodes of the buckets above `low` are refined, and some of `low` itself.

    The nodes of that bucket go through the queue. Those that are there from the start have their own pixel scale as
    their limit, since their parents are in a larger bucket. Children of one of them are queued by their own pixel
    scale, too, with their limit kept apart. Leaves that are there from the start stay out of the queue, which is
    faster: those among them count as taken out that come before the least node that was.

    Args:
        trees, stop, slots, wanted, cut: as for `find_cut`; `slots.pending` is overwritten.
        count: number of slots in use.
        runs: number of refined nodes in `slots.queue`.
        low: the bucket in which the budget may end, -1 if it does not.

    Returns:
        as `find_cut`; `last` is -1 if the budget does not end in this bucket, and there is no cut unless `low` is -1.
    """
    nodes, views, _, _ = trees
    smallest, budget = stop
    node, limit, instance, first, queue, path, heap, _ = slots  # path: the limit of a slot in the queue
    wanted[:] = 0
    for run in range(runs):
        at = queue[run]
        if first[run] == first[run + 1]:  # missing: no longer a leaf where the queue decides, and again one above
            limit[at] &= ~LEAF
            limit[at] |= LEAF if limit[at] >> BUCKET_BITS > low else 0
    selected, length, leaves, missing, small = 0, 0, 0, len(views) - first[0], 0
    least = INFINITE_BITS
    # Nodes from `bottom` on go through the queue, those from `top` on are refined before that.
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
            start, children = np.int64(record.child_start), np.int64(record.child_count)
            request_chunks(wanted, trees, view, start, children, from_bits(bits))
            if begin == end:
                missing += 1
                continue
            least = min(least, bits)
        for at in range(begin, end):
            # Branch-free again: each node is written to the cut, and stays there if it is drawn or queued.
            bits = limit[at] & ~LEAF
            below, above = bits < bottom, bits >= top
            put(cut, selected, node[at], limit[at] if above else bits, instance[at])
            is_leaf = limit[at] < 0
            queued = (not below) & (not above)
            queue[runs + leaves] = selected
            leaves += queued & is_leaf
            selected += below | is_leaf
            heap[length] = at
            length += queued & (not is_leaf)
            small |= below & (not is_leaf)
    if low < 0:
        return selected, PIXEL if small else MISSING if missing else EXHAUSTED, missing, from_bits(least), -1
    for entry in range(length):
        at = heap[entry]
        path[at] = limit[at]
    for at in range(length):
        sift_up(node, limit, instance, heap, at)
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
        if limit[at] >> BUCKET_BITS < low:
            break
        if drawn + children - 1 > budget:  # even if they are not resident, as in Spark
            for entry in range(length):
                queued_at = heap[entry]
                put(cut, selected, node[queued_at], path[queued_at], instance[queued_at])
                selected += 1
            last = limit[least_at], instance[least_at], node[least_at]
            for entry in range(runs, runs + leaves):
                leaf = queue[entry]
                if (cut.limit[leaf], cut.instance[leaf], cut.node[leaf]) > last:
                    cut.limit[leaf] |= LEAF
            return selected, BUDGET, missing, from_bits(least), at
        length -= 1
        heap[0] = heap[length]
        sift_down(node, limit, instance, heap, length)
        if children:
            request_chunks(wanted, trees, view, start, children, from_bits(path[at]))
        if children == 0 or not is_resident(trees, view, start, children):
            missing += children > 0
            put(cut, selected, node[at], path[at] | LEAF, instance[at])
            selected += 1
            continue
        if count + children > len(node):
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
