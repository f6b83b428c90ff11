"""Selects the nodes that the quality builder merges: the cheapest pairs of neighbours along a curve.

The quality builder's node row is one cache line: 16 float32 for each node of the growing tree. Lengths are in a unit
near the median scale, with the origin in the middle of the scene, so that float32 holds their squares and products.
"""

from __future__ import annotations

import math

import numpy as np

from ...support.fast_math import log2
from ...support.jit import kernel, prange

f32 = np.float32

#: First columns of a node row: centre, covariance of the profile (xx yy zz xy xz yz), colour, logarithm of the
#: covariance's determinant, coverage (opacity * area), density of the coverage (see `profile.py`), and the weight of
#: the colour, which is the sum of the leaves' weights; then the number of columns.
CENTER, COVARIANCE, COLOR, LOG_DET, COVERED, DENSITY, WEIGHT, WIDTH = 0, 3, 9, 12, 13, 14, 15, 16

#: Columns that the cost reads: all but the last two, side by side for a whole block.
LANES = 14

#: Nodes in a block: its columns, 30 KB, stay in the first-level cache. Results do not depend on it.
BLOCK = 512

#: Cost of a squared colour difference of 1 (channels are 0..1), in nats of shape. Between 3 and 10 it matters little
#: (docs/decisions/2026-11-21-fidelity.md).
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
    """Cost of merging node first + i with that `step` places on: Runnalls' bound on the Kullback-Leibler divergence.

    With coverages w as weights, and covariances P, it is ((w_i + w_j) ln|P_ij| - w_i ln|P_i| - w_j ln|P_j|) / 2
    (Runnalls 2007), plus COLOR_COST times Ward's variance of the colours. Branch-free, and columns are contiguous, so
    that LLVM vectorizes over pairs; with a slice of `lanes` instead of `first` it does not, and takes four times as
    long.

    Args:
        lanes: (LANES, at least first + count + step) float32 columns of node rows, C-contiguous.
        first: the first node.
        step: distance between the nodes of a pair.
        count: number of pairs.
        largest: float32, units squared; a pair is never merged if its covariance has a larger trace.
        cost: (at least count,) float32, filled.
    """
    x, y, z = lanes[0, first:], lanes[1, first:], lanes[2, first:]
    xx, yy, zz = lanes[3, first:], lanes[4, first:], lanes[5, first:]
    xy, xz, yz = lanes[6, first:], lanes[7, first:], lanes[8, first:]
    red, green, blue, logs, weight = (
        lanes[9, first:],
        lanes[10, first:],
        lanes[11, first:],
        lanes[12, first:],
        lanes[13, first:],
    )
    for i in range(count):
        j = i + step
        wi, wj = weight[i], weight[j]
        inverse = f32(1) / (wi + wj)
        a, b = wi * inverse, wj * inverse
        ab = a * b
        dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
        mxx = a * xx[i] + b * xx[j] + ab * dx * dx
        myy = a * yy[i] + b * yy[j] + ab * dy * dy
        mzz = a * zz[i] + b * zz[j] + ab * dz * dz
        mxy = a * xy[i] + b * xy[j] + ab * dx * dy
        mxz = a * xz[i] + b * xz[j] + ab * dx * dz
        myz = a * yz[i] + b * yz[j] + ab * dy * dz
        joint = log_det(mxx, myy, mzz, mxy, mxz, myz)
        dr, dg, db = red[j] - red[i], green[j] - green[i], blue[j] - blue[i]
        shape = f32(0.5) * (wi * (joint - logs[i]) + wj * (joint - logs[j]))
        total = shape + COLOR_COST * (wi * b) * (dr * dr + dg * dg + db * db)
        cost[i] = total if mxx + myy + mzz <= largest else NEVER


@kernel(parallel=True)
def find_partners(rows, nodes, window, largest):
    """The cheapest partner of each node among its neighbours in a list.

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
        lanes = np.empty((LANES, BLOCK + 2 * window), np.float32)
        cost = np.empty(BLOCK + window, np.float32)
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
            pair_costs(lanes, first, step, count, largest, cost)
            keep_cheaper(cost, count, best[first:], at[first:], low + first, low + first + step)
            keep_cheaper(cost, count, best[first + step :], at[first + step :], low + first + step, low + first)
        for i in range(begin, end):
            partner[i], lowest[i] = at[i - low], best[i - low]
    return partner, lowest


@kernel()
def keep_cheaper(cost, count, best, at, here, there):
    """Where cost[i] is less than best[i], sets best[i] to it, and at[i], the partner of here + i, to there + i.

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


@kernel()
def match_pairs(nodes, partner, cost, limit, made):
    """Pairs of nodes that are each other's cheapest partner, and the list in which merged nodes replace them.

    Args:
        nodes: (n,) uint32.
        partner, cost: of `find_partners`.
        limit: largest cost of a pair, float32.
        made: the node that the first pair is merged into; the next pair's is one more.

    Returns:
        pairs: (P, 2) uint32.
        rest: (n - P,) uint32, the list in its order; a merged node replaces the first of its pair.
    """
    n = len(nodes)
    mutual = 0
    for i in range(n):
        j = partner[i]
        mutual += j > i and partner[j] == i and cost[i] <= limit
    pairs, rest = np.empty((mutual, 2), np.uint32), np.empty(n - mutual, np.uint32)
    found = left = 0
    for i in range(n):
        j = partner[i]
        if j >= 0 and partner[j] == i and cost[i] <= limit:
            if j < i:
                continue
            pairs[found, 0], pairs[found, 1] = nodes[i], nodes[j]
            rest[left] = made + found
            found += 1
        else:
            rest[left] = nodes[i]
        left += 1
    return pairs, rest
