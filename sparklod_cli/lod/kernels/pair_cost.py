"""Selects the nodes that the quality builder merges: the cheapest pairs of neighbours along a curve.

The quality builder's node row is one cache line: 16 float32 for each node of the growing tree. Lengths are in a unit
near the median scale, with the origin in the middle of the scene, so that float32 holds their squares and products.
`nodes` (n,) are indices of rows in the order of the curve; `partner` and the costs are (n,), too.
"""

from __future__ import annotations

import math

import numpy as np

from ...system.fast_math import log2
from ...system.jit import f4, i4, i8, kernel, out, u4

f32 = np.float32

#: First columns of a node row: centre, covariance of the profile (xx yy zz xy xz yz), colour, logarithm of the
#: covariance's determinant, coverage (opacity * area), density of the coverage (see `profile.py`), and the weight of
#: the colour, which is the sum of the leaves' weights; then the number of columns.
CENTER, COVARIANCE, COLOR, LOG_DET, COVERED, DENSITY, WEIGHT, WIDTH = 0, 3, 9, 12, 13, 14, 15, 16

#: Columns that the cost reads: all but the last two, side by side for a whole block.
LANES = 14

#: Nodes in a block: its columns, 30 KB, stay in the first-level cache. Results do not depend on it.
BLOCK = 512

#: The number of pairs whose costs are computed at once is a multiple of this, which vectors divide: the rest of a loop
#: takes as long for each pair as a vector. Results beyond the pairs are not used. Chosen.
SIDE_BY_SIDE = 16

#: Cost of a squared colour difference of 1 (channels are 0..1), in nats of shape. Between 3 and 10 it matters little
#: (benchmarks/notes/quality-builder.md).
COLOR_COST = f32(4)

#: Least variance along an axis in the cost, as a share of the trace: flatter splats are not cheaper to merge. Chosen.
FLATTEST = f32(1e-5)

#: Least trace of a covariance in the cost, units squared, so that a node without extent has a logarithm. Chosen.
LEAST_TRACE = f32(1e-30)

LN2 = f32(math.log(2))

#: The cost of a pair that must not be merged.
NEVER = f32(np.inf)


@kernel(inline=True)
def log_det(xx, yy, zz, xy, xz, yz):
    """Natural logarithm of a covariance's determinant, float32, from its pivots, none below FLATTEST of the trace."""
    trace = xx + yy + zz + LEAST_TRACE
    least = FLATTEST * trace
    inverse = f32(1) / trace
    first = max(xx, least)
    upper = xy / first
    second = max(yy - upper * xy, least)
    rest = yz - upper * xz
    third = max(zz - xz * xz / first - rest * rest / second, least)
    product = (first * inverse) * (second * inverse) * (third * inverse)
    return (f32(3) * log2(trace) + log2(product)) * LN2


@kernel()
def pair_costs(lanes, first, step, count, largest, cost):
    """Fill the costs of merging node first + i with that `step` places on: Runnalls' bound on the divergence.

    With coverages w as weights, and covariances P, it is ((w_i + w_j) ln|P_ij| - w_i ln|P_i| - w_j ln|P_j|) / 2
    (Runnalls 2007), plus COLOR_COST times Ward's variance of the colours. Branch-free, and columns are contiguous, so
    that LLVM vectorizes over pairs; with a slice of `lanes` instead of `first` it does not, and takes four times as
    long. Indices are unsigned: of signed ones it cannot tell that none counts from the end, and it gathers the second
    nodes one by one.

    Args:
        lanes: (LANES, at least first + count + step) columns of node rows, C-contiguous.
        largest: units squared; a pair is never merged if its covariance has a larger trace.
        cost: (at least count,) filled.
    """
    start, distance = np.uint64(first), np.uint64(step)
    for i in range(count):
        p = start + np.uint64(i)
        q = p + distance
        wi, wj = lanes[13, p], lanes[13, q]
        inverse = f32(1) / (wi + wj)
        a, b = wi * inverse, wj * inverse
        ab = a * b
        dx, dy, dz = lanes[0, q] - lanes[0, p], lanes[1, q] - lanes[1, p], lanes[2, q] - lanes[2, p]
        mxx = a * lanes[3, p] + b * lanes[3, q] + ab * dx * dx
        myy = a * lanes[4, p] + b * lanes[4, q] + ab * dy * dy
        mzz = a * lanes[5, p] + b * lanes[5, q] + ab * dz * dz
        mxy = a * lanes[6, p] + b * lanes[6, q] + ab * dx * dy
        mxz = a * lanes[7, p] + b * lanes[7, q] + ab * dx * dz
        myz = a * lanes[8, p] + b * lanes[8, q] + ab * dy * dz
        joint = log_det(mxx, myy, mzz, mxy, mxz, myz)
        dr, dg, db = lanes[9, q] - lanes[9, p], lanes[10, q] - lanes[10, p], lanes[11, q] - lanes[11, p]
        shape = f32(0.5) * (wi * (joint - lanes[12, p]) + wj * (joint - lanes[12, q]))
        total = shape + COLOR_COST * (wi * b) * (dr * dr + dg * dg + db * db)
        cost[i] = total if mxx + myy + mzz <= largest else NEVER


@kernel(i8, f4[:, :], u4[:], i8, f4, out(i4[:]), out(f4[:]), ranges=True)
def find_partners(start, stop, rows, nodes, window, largest, partner, lowest):
    """Fill `partner`, an index into `nodes` or -1, at most `window` places away, and its cost."""
    lanes = np.empty((LANES, BLOCK + 2 * window + SIDE_BY_SIDE), np.float32)
    cost = np.empty(BLOCK + window + SIDE_BY_SIDE, np.float32)
    best, at = np.empty(BLOCK + 2 * window, np.float32), np.empty(BLOCK + 2 * window, np.int32)
    for begin in range(start, stop, BLOCK):
        end = min(stop, begin + BLOCK)
        low, high = max(0, begin - window), min(len(nodes), end + window)
        best[:], at[:] = NEVER, -1
        for i in range(low, high):
            for column in range(LANES):
                lanes[column, i - low] = rows[nodes[i], column]
        for step in range(1, window + 1):
            # Pairs with at least one node in the block; the first node may lie before it.
            first = max(low, begin - step) - low
            count = min(end - low, high - low - step) - first
            if count <= 0:
                continue
            pair_costs(lanes, first, step, -(-count // SIDE_BY_SIDE) * SIDE_BY_SIDE, largest, cost)
            keep_cheaper(cost, count, best[first:], at[first:], low + first, low + first + step)
            keep_cheaper(cost, count, best[first + step :], at[first + step :], low + first + step, low + first)
        for i in range(begin, end):
            partner[i], lowest[i] = at[i - low], best[i - low]


@kernel()
def keep_cheaper(cost, count, best, at, here, there):
    """Set best[i] to cost[i] and at[i], the partner of here + i, to there + i, where that cost is less.

    Among equal costs, that partner wins whose index differs from the node's in the lowest bits. That relation is
    symmetric, so among many equal splats half choose each other. `cost` is of pairs (here + i, there + i).
    """
    for i in range(count):
        own, new = np.int32(here + i), np.int32(there + i)
        lower = (cost[i] < best[i]) | ((cost[i] == best[i]) & ((own ^ new) < (own ^ at[i])))
        best[i] = cost[i] if lower else best[i]
        at[i] = new if lower else at[i]


@kernel(inline=True)
def is_mutual(i, partner, cost, limit):
    """Return whether a node and its partner chose each other, at no more than a cost."""
    j = partner[i]
    return (j >= 0) & (partner[j] == i) & (cost[i] <= limit)


@kernel(i8, i4[:], f4[:], f4, out(i8[:, :]), ranges=True)
def count_pairs(start, stop, partner, cost, limit, counts):
    """Count the pairs of nodes that are each other's cheapest partner, at a cost of at most `limit`.

    `counts` (blocks, 2) gets the nodes of each block that are the first, and the second, of a pair.
    """
    n, blocks = len(partner), len(counts)
    for block in range(start, stop):
        first = second = 0
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            merges = is_mutual(i, partner, cost, limit)
            first += merges & (partner[i] > i)
            second += merges & (partner[i] < i)
        counts[block, 0], counts[block, 1] = first, second


@kernel(i8, u4[:], i4[:], f4[:], f4, i8, i8[:, :], out(u4[:, :]), out(u4[:]), ranges=True)
def list_pairs(start, stop, nodes, partner, cost, limit, made, before, pairs, rest):
    """List the pairs of `count_pairs`, and the nodes after they have merged.

    Args:
        made: the node that the first pair is merged into; the next pair's is one more.
        before: (blocks, 2) sums of `counts` of the blocks before.
        pairs: (P, 2) filled.
        rest: (n - P,) filled with the nodes in their order; a merged one replaces the first of its pair.
    """
    n, blocks = len(nodes), len(before)
    for block in range(start, stop):
        begin = n * block // blocks
        found, left = before[block, 0], begin - before[block, 1]
        for i in range(begin, n * (block + 1) // blocks):
            j = partner[i]
            merges = is_mutual(i, partner, cost, limit)
            if merges & (j < i):
                continue
            rest[left] = made + found if merges else nodes[i]
            left += 1
            if merges:
                pairs[found, 0], pairs[found, 1] = nodes[i], nodes[j]
                found += 1
