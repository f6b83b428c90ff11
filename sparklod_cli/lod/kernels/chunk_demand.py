"""How likely viewers are to need each family of a tree, for the order of chunks."""

from __future__ import annotations

import math

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f8, i4, out, u1
from .pixel_scale import NODES, VIEWS, ZERO, pixel_scale

#: Viewpoints that one pass over the families serves. Measured: 8 take half as long as one by one.
LANES = 8

#: Buckets of pixel scales: the upper bits of a float32, 1.6 to 3.1 % wide, which cover all of its numbers above 0.
BUCKET_SHIFT = 18
BUCKETS = 1 << (31 - BUCKET_SHIFT)

#: Bytes that each thread takes for a family: its buckets.
DEMAND_BYTES = 2 * LANES


@kernel(NODES, i4[:], VIEWS, f8, f8, out(u1[:, :]), parallel=True)
def fill_demand(families, parent, views, least, most, demand):
    """Fills the chance that a viewer at each viewpoint refines a family's parent, if its budget is unknown.

    A viewer refines the largest nodes first. It needs a family if its budget has room for all families whose pixel
    scale, limited by those of their ancestors, is at least as large. The logarithm of budgets is uniform between
    `least` and `most` nodes.

    Args:
        families: (F,) `pixel_scale.NODE`, the parents of families, parents before their children.
        parent: (F,) int32, the family to which each parent belongs; -1 for the root.
        views: (V,) `pixel_scale.VIEW`; V is a multiple of `LANES`.
        least, most: budgets in nodes, float64; `least` is less than `most`.
        demand: (F, V) uint8, filled: 255 for certain. No family has more than its parent.
    """
    span = math.log(most / least)
    for block in prange(len(views) // LANES):
        bucket = np.empty((len(families), LANES), np.int16)
        nodes = np.zeros((LANES, BUCKETS), np.int64)
        code = np.zeros((LANES, BUCKETS), np.uint8)
        first = block * LANES
        for family in range(len(families)):
            above = parent[family]
            for lane in range(LANES):
                scale = pixel_scale(families[family], views[first + lane])
                if not scale >= ZERO:  # also not a number
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
