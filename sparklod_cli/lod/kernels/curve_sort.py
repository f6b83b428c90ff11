"""Sorts nodes along a Morton curve in few parallel loops, as each waits for its slowest thread.

The nodes are split by the upper bits of their places on the curve into parts, each of which one thread then sorts,
while it is in its cache. A part with many nodes in one place takes longer; then other threads wait.
"""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, f8, i8, u4
from .node_rows import CURVE_BITS, place_on_curve

#: Upper bits of a place by which nodes are split: 2048 counters fit the first-level cache. Chosen.
SPLIT_BITS = 11

#: Bits that a pass of the sort of a part sorts by, and how many passes make up a place: an even number, so that the
#: result is where the part was. Chosen.
DIGIT_BITS, PASSES = 10, 4

#: Parts for each thread. Chosen: more even out what is unevenly spread, and each takes time to begin.
PARTS = 4


@kernel()
def sort_part(keys, index, other_keys, other_index, begin, end):
    """Sorts `index` by `keys` from `begin` to `end`, stably; writes over the same range of the others."""
    count = np.empty(1 << DIGIT_BITS, np.int64)
    mask = np.uint64((1 << DIGIT_BITS) - 1)
    for turn in range(PASSES):
        shift = np.uint64(turn * DIGIT_BITS)
        count[:] = 0
        for i in range(begin, end):
            count[(keys[i] >> shift) & mask] += 1
        total = begin
        for digit in range(len(count)):
            total, count[digit] = total + count[digit], total
        for i in range(begin, end):
            digit = (keys[i] >> shift) & mask
            to = count[digit]
            count[digit] = to + 1
            other_keys[to], other_index[to] = keys[i], index[i]
        keys, other_keys = other_keys, keys
        index, other_index = other_index, index


@kernel(f4[:, :], u4[:], i8, u4[:], f8[:], f8, i8, parallel=True)
def sort_along_curve(rows, row, leaves, nodes, low, step, threads):
    """Nodes in the order of their places on the curve, those in one place in the order that they had.

    Args:
        rows: node rows of `pair_cost.py`; or any whose first columns are the centre.
        row: (leaves or more,) uint32 row of each merged node; that of a leaf is its own.
        leaves: number of leaves; nodes from there on are merged.
        nodes: (n,) uint32.
        low, step: see `node_rows.morton_keys`.
        threads: that work; the result does not depend on it.

    Returns:
        (n,) uint32 nodes, and (n,) uint32 their rows.
    """
    n = len(nodes)
    keys, index, at = np.empty(n, np.uint64), np.empty(n, np.uint32), np.empty(n, np.uint32)
    buckets, shift = 1 << SPLIT_BITS, np.uint64(3 * CURVE_BITS - SPLIT_BITS)
    count = np.zeros((threads, buckets), np.int64)
    for block in prange(threads):
        for i in range(n * block // threads, n * (block + 1) // threads):
            node = nodes[i]
            at[i] = node if node < leaves else row[node - leaves]
            keys[i], index[i] = place_on_curve(rows, at[i], low, step), i
            count[block, keys[i] >> shift] += 1
    other_keys, other_index = np.empty(n, np.uint64), np.empty(n, np.uint32)
    parts = 1 if threads == 1 else PARTS * threads
    ends = np.full(parts, n, np.int64)
    if parts > 1:
        total = part = 0
        for bucket in range(buckets):
            for block in range(threads):
                total, count[block, bucket] = total + count[block, bucket], total
            while part < parts - 1 and total >= n * (part + 1) // parts:
                ends[part] = total
                part += 1
        for block in prange(threads):
            for i in range(n * block // threads, n * (block + 1) // threads):
                bucket = keys[i] >> shift
                to = count[block, bucket]
                count[block, bucket] = to + 1
                other_keys[to], other_index[to] = keys[i], index[i]
        keys, other_keys = other_keys, keys
        index, other_index = other_index, index
    sorted_nodes, sorted_at = np.empty(n, np.uint32), np.empty(n, np.uint32)
    for part in prange(parts):
        begin, end = ends[part - 1] if part > 0 else 0, ends[part]
        sort_part(keys, index, other_keys, other_index, begin, end)
        for i in range(begin, end):
            sorted_nodes[i], sorted_at[i] = nodes[index[i]], at[index[i]]
    return sorted_nodes, sorted_at
