"""The nearest code of each row, looked for among the neighbours of the code that it has.

Codes are in groups of GROUP whose codes are near each other, so that the neighbours of a code are found in the groups
that are nearest to its own. Distances are squared, and computed for many codes at a time: of a block of codes, the
same coefficient is beside itself in memory.
"""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, i4, i8, out, u4

#: Codes of a group.
GROUP = 256

#: Codes whose distance to a row is computed at a time.
LANES = 16

#: Codes whose rows are processed by one iteration of a parallel loop.
SHARE = 64


@kernel(f4[:, :], f4[:, :, :], f4[:, :], i8, out(i4[:, :]), out(f4[:, :]), parallel=True)
def find_neighbours(codes, blocks, groups, search, near, distance):
    """Fills the nearest other codes of each code, nearest first, from the groups that are nearest to its own.

    Args:
        codes: (C, D) float32.
        blocks: (G, D, GROUP) float32, the codes of each group.
        groups: (G, D) float32, the mean of each.
        search: number of groups to search, at most G.
        near: (C, n) int32, filled; the code itself where there are not as many others.
        distance: (C, n) float32, filled with squared distances, infinite there.
    """
    width, count = codes.shape[1], near.shape[1]
    for g in prange(len(groups)):
        away = np.zeros(len(groups))
        for h in range(len(groups)):
            for d in range(width):
                x = np.float64(groups[g, d]) - np.float64(groups[h, d])
                away[h] += x * x
        nearest = np.argsort(away, kind="mergesort")[:search]
        sums = np.empty(GROUP, np.float32)
        for c in range(g * GROUP, min(len(codes), g * GROUP + GROUP)):
            near[c] = c
            distance[c] = np.inf
            for h in nearest:
                sums[:] = 0
                for d in range(width):
                    for lane in range(GROUP):
                        x = codes[c, d] - blocks[h, d, lane]
                        sums[lane] += x * x
                for lane in range(min(GROUP, len(codes) - h * GROUP)):
                    if sums[lane] < distance[c, count - 1] and h * GROUP + lane != c:
                        at = count - 1
                        while at > 0 and distance[c, at - 1] > sums[lane]:
                            distance[c, at], near[c, at] = distance[c, at - 1], near[c, at - 1]
                            at -= 1
                        distance[c, at], near[c, at] = sums[lane], h * GROUP + lane


@kernel(f4[:, :], u4[:], i8[:], f4[:, :], i4[:, :], f4[:, :], out(i4[:]), out(f4[:]), parallel=True)
def choose_codes(rows, members, begin, codes, near, distance, labels, errors):
    """Fills the nearest code of each row, of the one that it has and that one's neighbours.

    No further neighbour is looked at than is twice as far from the code as the row is: by the triangle inequality, none
    beyond is nearer to the row.

    Args:
        rows: (N, D) float32.
        members: (M,) uint32 rows, code after code.
        begin: (C + 1,) int64, where the rows of each code begin in `members`.
        codes: (C, D) float32.
        near: (C, n) int32, the neighbours of each code, nearest first; n is a multiple of LANES.
        distance: (C, n) float32, at most their squared distances.
        labels: (N,) int32, filled for all members.
        errors: (N,) float32, filled with the squared distance of each row to its code.
    """
    width, parts = codes.shape[1], near.shape[1] // LANES
    for share in prange((len(codes) + SHARE - 1) // SHARE):
        block, sums = np.empty((parts, width, LANES), np.float32), np.empty(LANES, np.float32)
        for c in range(share * SHARE, min(len(codes), share * SHARE + SHARE)):
            filled = 0
            for a in range(begin[c], begin[c + 1]):
                i = members[a]
                best, label = np.float32(0), c
                for d in range(width):
                    x = rows[i, d] - codes[c, d]
                    best += x * x
                own = best
                for part in range(parts):
                    if distance[c, part * LANES] >= np.float32(4) * own:
                        break
                    if filled == part:
                        for lane in range(LANES):
                            for d in range(width):
                                block[part, d, lane] = codes[near[c, part * LANES + lane], d]
                        filled += 1
                    sums[:] = 0
                    for d in range(width):
                        for lane in range(LANES):
                            x = rows[i, d] - block[part, d, lane]
                            sums[lane] += x * x
                    for lane in range(LANES):
                        if sums[lane] < best:
                            best, label = sums[lane], near[c, part * LANES + lane]
                labels[i] = label
                errors[i] = best
