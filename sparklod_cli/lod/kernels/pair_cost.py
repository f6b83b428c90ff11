"""Who merges with whom: the cost of pairs of neighbours along a curve through space, and each one's cheapest.

A row of state is a cache line: what is known of a node while the tree grows. Lengths are in a unit near the median
scale, from the middle of the scene, so that float32 holds squares and products of them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...support.fast_math import log2
from ...support.jit import kernel

f32 = np.float32

#: First column of a row of state: centre, covariance of the profile (xx yy zz xy xz yz), colour, logarithm of the
#: covariance's determinant, what it covers (opacity * area), the density of that (see `profile.py`), and the weight of
#: its colour, which is the sum of its leaves'.
CENTER, COVARIANCE, COLOR, LOG_DET, COVERED, DENSITY, WEIGHT, WIDTH = 0, 3, 9, 12, 13, 14, 15, 16

#: What the cost reads of a row: all but the last two, side by side for a whole block.
LANES = 14

#: Nodes of a block; its columns stay in the first-level cache.
BLOCK = 512

#: How much a squared difference of colour (0..1 a channel) costs beside one nat of shape.
COLOR_COST = f32(4)

#: An axis of an ellipsoid counts as at least this share of the trace, squared: flatter is not cheaper to merge.
FLATTEST = f32(1e-5)

LN2 = f32(math.log(2))
NEVER = f32(np.inf)


@kernel(inline=True)
def log_det(xx, yy, zz, xy, xz, yz):
    """Logarithm of the determinant of a covariance, float32, from its pivots, none below FLATTEST of the trace."""
    trace = xx + yy + zz + f32(1e-30)
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
def block_costs(lanes, step, count, largest, cost):
    """Cost of merging node i with i + step: Runnalls' bound on the Kullback-Leibler divergence, times what both cover.

    With w for what they cover and P for covariances it is ((w_i + w_j) ln|P_ij| - w_i ln|P_i| - w_j ln|P_j|) / 2
    (Runnalls 2007), and Ward's variance for their colours. Free of branches, so that the compiler works on several at
    a time.

    Args:
        lanes: (LANES, at least count + step) float32 columns of state.
        step: how far apart.
        count: how many pairs.
        largest: trace of the covariance above which nothing is merged, float32.
        cost: (at least count,) float32, filled.
    """
    x, y, z = lanes[0], lanes[1], lanes[2]
    xx, yy, zz, xy, xz, yz = lanes[3], lanes[4], lanes[5], lanes[6], lanes[7], lanes[8]
    red, green, blue, logs, weight = lanes[9], lanes[10], lanes[11], lanes[12], lanes[13]
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
def cheapest(state, nodes, window, largest):
    """For each node its cheapest partner among those that are near it in a list.

    Args:
        state: rows as above. nodes: (n,) uint32 rows of it, in the order of a curve.
        window: how far a partner may be in the list.
        largest: see `block_costs`.

    Returns:
        partner: (n,) int32 place in the list, -1 for none. cost: (n,) float32.
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
                lanes[column, i - low] = state[nodes[i], column]
        for step in range(1, window + 1):
            # Pairs with at least one in the block; the first of them may lie before it.
            first = max(low, begin - step) - low
            count = min(end - low, high - low - step) - first
            if count <= 0:
                continue
            block_costs(lanes[:, first:], step, count, largest, cost)
            take_lower(cost, count, best[first:], at[first:], low + first, low + first + step)
            take_lower(cost, count, best[first + step :], at[first + step :], low + first + step, low + first)
        for i in range(begin, end):
            partner[i], lowest[i] = at[i - low], best[i - low]
    return partner, lowest


@kernel()
def take_lower(cost, count, best, at, here, there):
    """Where cost[i] is lower than best[i], takes it, and there + i for the partner of here + i.

    Of equal costs the partner wins whose place differs in lower bits: one for which it is the same, so that among many
    equal splats half find each other.
    """
    for i in range(count):
        own, new = np.int32(here + i), np.int32(there + i)
        lower = (cost[i] < best[i]) | ((cost[i] == best[i]) & ((own ^ new) < (own ^ at[i])))
        best[i] = cost[i] if lower else best[i]
        at[i] = new if lower else at[i]


@kernel()
def pair_up(nodes, partner, cost, limit, made):
    """Pairs of nodes that are each other's cheapest, and the list without them but with what they become.

    Args:
        nodes: (n,) uint32. partner, cost: of `cheapest`.
        limit: what a pair may cost.
        made: the node that the first pair becomes, counted up from there.

    Returns:
        pairs (P, 2) uint32, and the list (n - P,) uint32 in its order, what a pair becomes in the place of its first.
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
