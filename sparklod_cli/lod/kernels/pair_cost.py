"""Selects the nodes that the quality builder merges: the cheapest pairs of neighbours along a curve.

The quality builder's node row is one cache line: 16 float32 for each node of the growing tree. Lengths are in a unit
near the median scale, with the origin in the middle of the scene, so that float32 holds their squares and products.
"""

from __future__ import annotations

import math

import numpy as np

from ...support.fast_math import log2
from ...support.jit import kernel, prange
from ...support.jit_types import f4, i4, i8, u4

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
#: takes as long for each pair as a vector. What is computed beyond the pairs is not used. Chosen.
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
        lanes: (LANES, at least first + count + step) float32 columns of node rows, C-contiguous.
        first: the first node.
        step: distance between the nodes of a pair.
        count: number of pairs.
        largest: float32, units squared; a pair is never merged if its covariance has a larger trace.
        cost: (at least count,) float32, filled.
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


@kernel(f4[:, :], u4[:], i8, f4, parallel=True)
def find_partners(rows, nodes, window, largest):
    """Return the cheapest partner of each node among its neighbours in a list.

    Args:
        rows: node rows, see above.
        nodes: (n,) uint32 indices of rows, in the order of the curve.
        window: largest distance of a partner in the list.
        largest: see `pair_costs`.

    Returns:
        partner: (n,) int32 index into `nodes`, -1 for none.
        cost: (n,) float32, of merging with it.
    """
    n = len(nodes)
    partner, lowest = np.full(n, -1, np.int32), np.full(n, NEVER, np.float32)
    for block in prange((n + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(n, block * BLOCK + BLOCK)
        low, high = max(0, begin - window), min(n, end + window)
        lanes = np.empty((LANES, BLOCK + 2 * window + SIDE_BY_SIDE), np.float32)
        cost = np.empty(BLOCK + window + SIDE_BY_SIDE, np.float32)
        best, at = np.full(BLOCK + 2 * window, NEVER, np.float32), np.full(BLOCK + 2 * window, -1, np.int32)
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
    return partner, lowest


@kernel()
def keep_cheaper(cost, count, best, at, here, there):
    """Set best[i] to cost[i] and at[i], the partner of here + i, to there + i, where that cost is less.

    Among equal costs, that partner wins whose index differs from the node's in the lowest bits. That relation is
    symmetric, so among many equal splats half choose each other.

    Args:
        cost: (at least count,) float32, of pairs (here + i, there + i).
        count: number of pairs.
        best: (at least count,) float32, updated.
        at: (at least count,) int32, updated.
        here, there: indices of the first pair's node and its partner.
    """
    for i in range(count):
        own, new = np.int32(here + i), np.int32(there + i)
        lower = (cost[i] < best[i]) | ((cost[i] == best[i]) & ((own ^ new) < (own ^ at[i])))
        best[i] = cost[i] if lower else best[i]
        at[i] = new if lower else at[i]


@kernel(u4[:], i4[:], f4[:], f4, i8, i8, parallel=True)
def match_pairs(nodes, partner, cost, limit, made, blocks):
    """Return pairs of nodes that are each other's cheapest partner, and the list in which merged nodes replace them.

    Args:
        nodes: (n,) uint32.
        partner, cost: of `find_partners`.
        limit: largest cost of a pair, float32.
        made: the node that the first pair is merged into; the next pair's is one more.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.

    Returns:
        pairs: (P, 2) uint32.
        rest: (n - P,) uint32, the list in its order; a merged node replaces the first of its pair.
    """
    n = len(nodes)
    begin = np.zeros(blocks + 1, np.int64)  # pairs whose first node is in a block before
    second = np.zeros(blocks + 1, np.int64)  # second nodes of pairs in a block before
    for block in prange(blocks):
        mutual = behind = 0
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            j = partner[i]
            merges = (j >= 0) & (partner[j] == i) & (cost[i] <= limit)
            mutual += merges & (j > i)
            behind += merges & (j < i)
        begin[block + 1], second[block + 1] = mutual, behind
    for block in range(blocks):
        begin[block + 1] += begin[block]
        second[block + 1] += second[block]
    pairs, rest = np.empty((begin[blocks], 2), np.uint32), np.empty(n - begin[blocks], np.uint32)
    for block in prange(blocks):
        found = begin[block]
        left = n * block // blocks - second[block]
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            j = partner[i]
            merges = (j >= 0) & (partner[j] == i) & (cost[i] <= limit)
            if merges & (j < i):
                continue
            rest[left] = made + found if merges else nodes[i]
            left += 1
            if merges:
                pairs[found, 0], pairs[found, 1] = nodes[i], nodes[j]
                found += 1
    return pairs, rest
