"""The row a builder works on, and what fills it from splats.

A builder touches centre, scale, rotation and opacity of a node together, so they lie together: one row of 11 float32 a
node. Leaves come first, sorted so that neighbours in space are neighbours in memory; merged nodes follow.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...model.gaussian import THOMSEN_P
from ...support.jit import kernel

CENTER, SCALE, QUAT, OPACITY, WIDTH = 0, 3, 6, 10, 11  # first column of each, and the number of columns

BLOCK = 256  # rows that are gathered before they are computed with, so that their cache misses overlap
#: What float32 holds: a merged splat of others that are farther apart is as large as that.
LARGEST = float(np.finfo(np.float32).max)

AXIS_FLOOR = np.float32(1e-20)
THOMSEN_P32, THOMSEN_ROOT, THIRD = np.float32(THOMSEN_P), np.float32(1 / THOMSEN_P), np.float32(1 / 3)


@kernel()
def ellipsoid_area(a, b, c):
    """Surface of an ellipsoid with semi-axes a, b, c (Knud Thomsen's formula).

    Any of them may be 0, but not all: an axis counts as at least AXIS_FLOOR of the longest, so that a needle weighs
    something.
    """
    largest = max(a, b, c)
    smallest = min(a, b, c)
    middle = max(min(a, b), min(max(a, b), c))
    # Powers of ratios at most 1 stay in range, and in float32, where a power of a product of scales would not.
    y = max(np.float32(middle / largest), AXIS_FLOOR) ** THOMSEN_P32
    z = max(np.float32(smallest / largest), AXIS_FLOOR) ** THOMSEN_P32
    mean = ((y + z + y * z) * THIRD) ** THOMSEN_ROOT
    return 4 * math.pi * np.float64(largest) * np.float64(largest) * np.float64(mean)


@kernel(parallel=True)
def extremes(center, scale, chunks):
    """Lowest and highest centre on each axis, (3,) float64 each, and the smallest and largest size, 2 * max(scale)."""
    n = len(center)
    low = np.full((chunks, 4), np.inf)
    high = np.full((chunks, 4), -np.inf)
    for c in prange(chunks):
        x0 = y0 = z0 = s0 = np.float32(np.inf)
        x1 = y1 = z1 = s1 = np.float32(-np.inf)
        for i in range(n * c // chunks, n * (c + 1) // chunks):
            x, y, z, s = center[i, 0], center[i, 1], center[i, 2], max(scale[i, 0], scale[i, 1], scale[i, 2])
            x0, y0, z0, s0 = min(x0, x), min(y0, y), min(z0, z), min(s0, s)
            x1, y1, z1, s1 = max(x1, x), max(y1, y), max(z1, z), max(s1, s)
        low[c, 0], low[c, 1], low[c, 2], low[c, 3] = x0, y0, z0, s0
        high[c, 0], high[c, 1], high[c, 2], high[c, 3] = x1, y1, z1, s1
    for c in range(1, chunks):
        for k in range(4):
            low[0, k] = min(low[0, k], low[c, k])
            high[0, k] = max(high[0, k], high[c, k])
    return low[0, :3], high[0, :3], 2 * low[0, 3], 2 * high[0, 3]


@kernel(parallel=True)
def fill_rows(index, center, scale, quat, opacity, geometry, weight):
    """Row i of geometry and weight from splat index[i]; a weight is opacity * area, float64."""
    n = len(index)
    for block in prange((n + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(n, block * BLOCK + BLOCK)
        for i in range(begin, end):
            for k in range(3):
                geometry[i, CENTER + k] = center[index[i], k]
        for i in range(begin, end):
            for k in range(3):
                geometry[i, SCALE + k] = scale[index[i], k]
        for i in range(begin, end):
            for k in range(4):
                geometry[i, QUAT + k] = quat[index[i], k]
        for i in range(begin, end):
            geometry[i, OPACITY] = opacity[index[i]]
        for i in range(begin, end):
            area = ellipsoid_area(geometry[i, SCALE], geometry[i, SCALE + 1], geometry[i, SCALE + 2])
            weight[i] = geometry[i, OPACITY] * area
