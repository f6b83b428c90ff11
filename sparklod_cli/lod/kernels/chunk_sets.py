"""Kernels of the order for streaming: demand for families, their division into chunks, their order within a chunk.

Sets of families are split in two, again and again, until each set is a chunk. A set is a slice of `sequence`, an array
of families, in descending order of size, parents before their children. Its *roots* are the families whose parents'
families are not in it; each family of a set has one root above it.

Arrays that kernels share: `members`, the families of the set; `set_of` (F,), the number of each family's set; `root`
(F,), the root above each family, or itself; `weight` (F,), for roots, the nodes of the families of the set below it,
its own included.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...system.jit import f8, fields, i4, i8, kernel, out, u1
from .pixel_scale import NODES, VIEWS, ZERO, pixel_scale
from .sort import AXIS_BITS, interleave

#: Ways to split a set: along x, y, z (whole subtrees of roots, by the parent's centre), or by size.
AXES = 4
SIZE = 3

#: Number of places of a split along each axis. Chosen.
BINS = 128

#: Up to this number of chunks, all divisions are tried; beyond, those with at least a quarter on either side, so that
#: the number of rounds is logarithmic. Chosen.
FEW_CHUNKS = 8

#: With room for fewer nodes than this in a part, a family that would leave room for one is skipped, since no family of
#: a builder has one node. Chosen.
NEARLY_FULL = 64

#: Viewpoints per pass over the families. Measured: 8 take half as long as one by one.
LANES = 8

#: Buckets of pixel scales: the upper bits of a float32, 1.6 to 3.1 % wide, which cover all of its numbers above 0.
BUCKET_SHIFT = 18
BUCKETS = 1 << (31 - BUCKET_SHIFT)

#: Bytes that each thread takes for a family: its buckets.
DEMAND_BYTES = 2 * LANES

#: Bits of a key below its depth, and the depth from which on families keep their order.
CODE_BITS = 57
DEEP = 63


@fields(i4[:], i4[:], i4[:, :], u1[:, :])
class Families(NamedTuple):
    """The families of a tree, in descending order of size."""

    parent: Any  # (F,) int32, the family that contains its parent; -1 for the children of the root
    count: Any  # (F,) int32, its nodes
    rank: Any  # (F, 3) int32, the rank of its parent's centre along x, y, z
    demand: Any  # (F, V) uint8, of `fill_demand`


@kernel()
def find_roots(families, members, number, set_of, root, weight):
    """Fill `set_of` and `root` of the members of a set, and the `weight` of its roots; return the number of roots.

    `number` identifies the set; no earlier set may have had it.
    """
    for i in range(len(members)):
        set_of[members[i]] = number
    roots = 0
    for i in range(len(members)):
        family = members[i]
        above = families.parent[family]
        if above >= 0 and set_of[above] == number:
            root[family] = root[above]
            weight[root[family]] += families.count[family]
        else:
            root[family] = family
            weight[family] = families.count[family]
            roots += 1
    return roots


@kernel()
def sum_of(values):
    """Return the sum of uint8 values."""
    total = 0
    for value in values:
        total += np.int64(value)
    return total


@kernel()
def fill_bins(families, members, root, weight, nodes, greatest):
    """Add the families of a set to the nodes (AXES, BINS) and greatest demands (AXES, BINS, V) of bins."""
    low, high = np.full(3, len(families.count)), np.zeros(3, np.int64)
    for i in range(len(members)):
        family = members[i]
        if root[family] == family:
            for axis in range(3):
                low[axis] = min(low[axis], families.rank[family, axis])
                high[axis] = max(high[axis], families.rank[family, axis])
    lanes = families.demand.shape[1]
    for i in range(len(members)):
        family = members[i]
        at = i * BINS // len(members)
        nodes[SIZE, at] += families.count[family]
        demand, most = families.demand[family], greatest[SIZE, at]  # rows, so that LLVM vectorizes over lanes
        for lane in range(lanes):
            most[lane] = max(most[lane], demand[lane])
        if root[family] != family:
            continue
        for axis in range(3):
            at = (families.rank[family, axis] - low[axis]) * BINS // (high[axis] - low[axis] + 1)
            nodes[axis, at] += weight[family]
            most = greatest[axis, at]
            for lane in range(lanes):  # no family of a subtree has more demand than its root
                most[lane] = max(most[lane], demand[lane])


@kernel()
def choose_split(nodes, greatest, size, chunks):
    """Return the axis (x, y, z or SIZE) and the chunks of the first part of the split with the least expected cost.

    As in the surface area heuristic of ray tracing, a viewer that needs any of a part is expected to fetch it whole:
    the cost of a split is the sum of nodes x viewers over both parts. Viewers are the sum of the greatest demands of
    all viewpoints.

    Args:
        nodes, greatest: of `fill_bins`.
        size: nodes of a chunk.
        chunks: number of chunks that the set fills, the last one perhaps partly; 2 or more.
    """
    total = nodes[SIZE].sum()
    lanes = greatest.shape[2]
    fewest = 1 if chunks <= FEW_CHUNKS else chunks // 4
    axis, share, least = SIZE, fewest, np.inf
    after = np.zeros((BINS + 1, lanes), np.uint8)
    before = np.zeros(lanes, np.uint8)
    for turn in range(AXES):
        tried = (turn + SIZE) % AXES  # by size first, which is always possible
        for at in range(BINS - 1, -1, -1):
            for lane in range(lanes):
                after[at, lane] = max(after[at + 1, lane], greatest[tried, at, lane])
        before[:] = 0
        passed, full = 0, fewest - 1
        for at in range(BINS):
            passed += nodes[tried, at]
            for lane in range(lanes):
                before[lane] = max(before[lane], greatest[tried, at, lane])
            filled = min(passed // size, chunks - fewest)
            if filled <= full:
                continue
            # A division inside this bin counts the bin on both sides; one at its end on the first side only.
            first, second = sum_of(before), sum_of(after[at if passed > filled * size else at + 1])
            while full < filled:
                full += 1
                cost = float(full * size) * first + float(total - full * size) * second
                if cost < least:
                    axis, share, least = tried, full, cost
    return axis, share


@kernel()
def mark_first_part(families, members, root, weight, axis, room):
    """Mark the families of the first part of a split, with room for `room` nodes, by a weight of -1; return if any.

    Families are taken in order while there is room; families that do not fit are skipped, so that nearly all of the
    room is used. In a split by size each family becomes its own root.
    """
    marked = False
    if axis == SIZE:
        for i in range(len(members)):
            family = members[i]
            above = families.parent[family]
            count = families.count[family]
            held_back = root[family] != family and weight[above] != -1
            root[family], weight[family] = family, 0
            if not held_back and count <= room and (room > NEARLY_FULL or room - count != 1):
                weight[family] = -1
                room -= count
                marked = True
        return marked
    ranks = np.empty(len(members), np.int64)
    roots = np.empty(len(members), np.int64)
    length = 0
    for i in range(len(members)):
        family = members[i]
        if root[family] == family:
            ranks[length], roots[length] = families.rank[family, axis], family
            length += 1
    for i in np.argsort(ranks[:length]):
        below = weight[roots[i]]
        if below <= room and (room > NEARLY_FULL or room - below != 1):
            weight[roots[i]] = -1
            room -= below
            marked = True
    return marked


@kernel()
def move_first_part(members, root, weight, spare):
    """Move the marked families to the front, both parts in their order; return the number of marked families."""
    length, rest = 0, 0
    for i in range(len(members)):
        family = members[i]
        if weight[root[family]] == -1:
            members[length] = family
            length += 1
        else:
            spare[rest] = family
            rest += 1
    for i in range(rest):
        members[length + i] = spare[i]
    return length


@kernel(i8, Families, i8[:, :], out(i4[:]), out(i4[:]), out(i4[:]), out(i8[:]), out(i4[:]), out(i8[:]), ranges=True)
def split_sets(start, stop, families, sets, sequence, set_of, root, weight, spare, lengths):
    """Split each set in two; the first part fills whole chunks, up to very few nodes.

    Args:
        sets: (S, 6) begin and end in `sequence`; a number that no set had before; nodes of a chunk; number of chunks
            that the set fills; room of the first part for a split by size, nodes, or 0 for any split.
        sequence: (F,) reordered within each set.
        set_of, root, weight, spare: (F,) working memory.
        lengths: (S,) filled with the number of families of each first part.
    """
    lanes = families.demand.shape[1]
    for i in range(start, stop):
        begin, end, number, size, chunks, room = sets[i]
        members = sequence[begin:end]
        roots = find_roots(families, members, number, set_of, root, weight)
        axis = SIZE
        if room == 0:
            nodes = np.zeros((AXES, BINS), np.int64)
            greatest = np.zeros((AXES, BINS, lanes), np.uint8)
            fill_bins(families, members, root, weight, nodes, greatest)
            axis, share = choose_split(nodes, greatest, size, chunks)
            room = share * size
        if roots == 1 or not mark_first_part(families, members, root, weight, axis, room):
            axis = SIZE  # a variable, since the constant has its own type, which would be compiled once more
            mark_first_part(families, members, root, weight, axis, room)
        lengths[i] = move_first_part(members, root, weight, spare[begin:end])


@kernel(i8, NODES, i4[:], VIEWS, f8, f8, out(u1[:, :]), ranges=True)
def fill_demand(start, stop, families, parent, views, least, most, demand):
    """Fill the probability that a viewer of unknown budget at each viewpoint refines a family's parent.

    A viewer refines the largest nodes first. It needs a family if its budget has room for all families whose pixel
    scale, limited by those of their ancestors, is at least as large. The logarithm of budgets is uniform between
    `least` and `most` nodes. The rows of a range are groups of LANES viewpoints.

    Args:
        families: (F,) the parents of families, parents before their children.
        parent: (F,) the family that contains each parent; -1 for the root.
        views: (V,), a multiple of `LANES`.
        demand: (F, V) filled, 255 for a probability of 1; never more than that of the parent's family.
    """
    span = math.log(most / least)
    bucket = np.empty((len(families), LANES), np.int16)
    nodes, code = np.empty((LANES, BUCKETS), np.int64), np.empty((LANES, BUCKETS), np.uint8)
    for first in range(start * LANES, stop * LANES, LANES):
        nodes[:] = 0
        for family in range(len(families)):
            above = parent[family]
            for lane in range(LANES):
                scale = pixel_scale(families[family], views[first + lane])
                if not scale >= ZERO:  # also NaN
                    scale = ZERO
                at = np.float32(scale).view(np.int32) >> BUCKET_SHIFT
                if above >= 0:  # buckets ascend as scales do, so that the least one has the least bucket
                    at = min(at, np.int32(bucket[above, lane]))
                bucket[family, lane] = at
                nodes[lane, at] += families[family].child_count
        for lane in range(LANES):
            needed = 0
            for at in range(BUCKETS - 1, -1, -1):
                needed += nodes[lane, at]
                chance = 1.0 - math.log(max(needed, 1) / least) / span
                code[lane, at] = np.uint8(255.0 * min(1.0, max(0.0, chance)))
        for family in range(len(families)):
            for lane in range(LANES):
                demand[family, first + lane] = code[lane, bucket[family, lane]]


@kernel(i8, i8[:], i4[:], i4[:, :], i8, out(i4[:]), out(i4[:]), out(i4[:]), ranges=True)
def sort_within_chunks(start, stop, bounds, parent, rank, axis_bits, sequence, chunk_of, depth):
    """Sort the families of each chunk by their depth within the chunk, then along a Morton curve.

    Neighbours in space have similar centres and colours, so they compress better; parents stay before their children.

    Args:
        bounds: (C + 1,) where each chunk begins in `sequence`, and the end.
        parent, rank: of `Families`.
        axis_bits: bits of the greatest rank.
        sequence: (F,) families, parents first; reordered.
        chunk_of: (F,) filled; must have no chunk's number before, as other threads may not have filled theirs yet.
        depth: (F,) working memory.
    """
    up, down = np.uint64(max(AXIS_BITS - axis_bits, 0)), np.uint64(max(axis_bits - AXIS_BITS, 0))
    for chunk in range(start, stop):
        begin, end = bounds[chunk], bounds[chunk + 1]
        members = sequence[begin:end].copy()
        keys = np.empty(len(members), np.uint64)
        for i in range(len(members)):
            chunk_of[members[i]] = chunk
        for i in range(len(members)):
            family = members[i]
            above = parent[family]
            depth[family] = depth[above] + 1 if above >= 0 and chunk_of[above] == chunk else 0
            if depth[family] >= DEEP:
                keys[i] = (np.uint64(DEEP) << np.uint64(CODE_BITS)) | np.uint64(i)
                continue
            x, y, z = np.uint64(rank[family, 0]), np.uint64(rank[family, 1]), np.uint64(rank[family, 2])
            code = interleave((x << up) >> down, (y << up) >> down, (z << up) >> down)
            keys[i] = (np.uint64(depth[family]) << np.uint64(CODE_BITS)) | (
                code >> np.uint64(3 * AXIS_BITS - CODE_BITS)
            )
        order = np.argsort(keys)
        for i in range(len(members)):
            sequence[begin + i] = members[order[i]]
