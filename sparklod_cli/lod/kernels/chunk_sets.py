"""Splits sets of families in two, again and again, until each set is a chunk.

A set is a slice of `sequence`, an array of families, in descending order of size, parents before their children. Its
*roots* are the families whose parents' families are not in it; each family of a set has one root above it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import fields, i4, i8, out, u1

#: Ways to split a set: along x, y, z (whole subtrees of roots, by the parent's centre), or by size.
AXES = 4
SIZE = 3

#: Places at which a split is tried along each axis. Chosen.
BINS = 128

#: Up to this number of chunks, every division of them is tried; of more, those that leave a quarter on either side, so
#: that the number of rounds stays logarithmic. Chosen.
FEW_CHUNKS = 8

#: When fewer nodes than this are left to fill a part, a family that would leave one is passed over, since no family of
#: a builder has one node. Chosen.
NEARLY_FULL = 64


@fields(i4[:], i4[:], i4[:, :], u1[:, :])
class Families(NamedTuple):
    """The families of a tree, in descending order of size; for a kernel to read.

    Attributes:
        parent: (F,) int32, the family that has its parent; -1 for the root's.
        count: (F,) int32, its nodes.
        rank: (F, 3) int32, the place of its parent's centre among all, along x, y, z.
        demand: (F, V) uint8, of `fill_demand`.
    """

    parent: Any
    count: Any
    rank: Any
    demand: Any


@kernel()
def find_roots(families, members, number, set_of, root, weight):
    """Finds the roots of a set, and the nodes below each.

    Args:
        families: `Families`.
        members: (S,) int32, the set.
        number: of the set, which no other set had.
        set_of: (F,) int32, filled for members: the number of the set.
        root: (F,) int32, filled for members: the root above, or the family itself.
        weight: (F,) int64, filled for roots: nodes of the families of the set below it, its own included.

    Returns:
        the number of roots.
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
    """The sum of uint8 values."""
    total = 0
    for value in values:
        total += np.int64(value)
    return total


@kernel()
def fill_bins(families, members, root, weight, nodes, greatest):
    """Fills the bins of a set, along each axis.

    Args:
        families, members, root, weight: as for `find_roots`, which filled the last two.
        nodes: (AXES, BINS) int64 of zeros, filled with the nodes of each bin.
        greatest: (AXES, BINS, V) uint8 of zeros, filled with the greatest demands in it.
    """
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
        for lane in range(lanes):
            greatest[SIZE, at, lane] = max(greatest[SIZE, at, lane], families.demand[family, lane])
        if root[family] != family:
            continue
        for axis in range(3):
            at = (families.rank[family, axis] - low[axis]) * BINS // (high[axis] - low[axis] + 1)
            nodes[axis, at] += weight[family]
            for lane in range(lanes):  # no family of a subtree has more demand than its root
                greatest[axis, at, lane] = max(greatest[axis, at, lane], families.demand[family, lane])


@kernel()
def choose_split(nodes, greatest, size, chunks):
    """The split of a set after which viewers are expected to fetch the fewest bytes.

    A part is expected to be fetched as a whole by those who need any of it, as in the surface area heuristic of ray
    tracing: the cost of a split is the sum over both parts of nodes x viewers, and viewers are counted by the greatest
    demand of each viewpoint.

    Args:
        nodes, greatest: of `fill_bins`.
        size: nodes of a chunk.
        chunks: number of chunks that the set fills, the last one perhaps partly; 2 or more.

    Returns:
        axis: x, y, z or SIZE.
        share: number of chunks in the first part.
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
            # All divisions that end in this bin cost as if they went through it, unless one ends where it does.
            first, second = sum_of(before), sum_of(after[at if passed > filled * size else at + 1])
            while full < filled:
                full += 1
                cost = float(full * size) * first + float(total - full * size) * second
                if cost < least:
                    axis, share, least = tried, full, cost
    return axis, share


@kernel()
def mark_first_part(families, members, root, weight, axis, room):
    """Marks what goes into the first part of a split, by a weight of -1.

    Families are taken in order as long as there is room; those that do not fit are passed over, so that the room is
    used up but for very few nodes.

    Args:
        families, members, root, weight: as for `find_roots`, which filled the last two. Filled again: for a split by
            size each family is its own root.
        axis: of the split.
        room: nodes of the first part.

    Returns:
        whether anything was marked.
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
    """Moves the marked families to the beginning; both parts keep their order.

    Args:
        members, root, weight: as for `mark_first_part`.
        spare: (S,) int32, working memory.

    Returns:
        the number of marked families.
    """
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


@kernel(Families, i8[:, :], out(i4[:]), out(i4[:]), out(i4[:]), out(i8[:]), out(i4[:]), out(i8[:]), parallel=True)
def split_sets(families, sets, sequence, set_of, root, weight, spare, lengths):
    """Splits each set in two; the first part of each fills whole chunks, but for very few nodes.

    Args:
        families: `Families`.
        sets: (S, 6) int64: begin and end in `sequence`; a number that no set had before; nodes of a chunk; number of
            chunks that the set fills; nodes that the first part has room for if it is to be split by size, or 0.
        sequence: (F,) int32, reordered within each set.
        set_of, root: (F,) int32, working memory.
        weight: (F,) int64, working memory.
        spare: (F,) int32, working memory.
        lengths: (S,) int64, filled with the number of families of each first part.
    """
    lanes = families.demand.shape[1]
    for i in prange(len(sets)):
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
            mark_first_part(families, members, root, weight, SIZE, room)
        lengths[i] = move_first_part(members, root, weight, spare[begin:end])
