"""Surfaces and bounds of splats."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...model.gaussian import THOMSEN_P
from ...support.jit import kernel, prange
from ...support.jit_types import f4, fields, i8

#: The largest float32, world units: centres and scales of merged splats are clamped to it.
LARGEST = float(np.finfo(np.float32).max)

#: Least semi-axis of `ellipsoid_area`, as a share of the longest: far below any needle in a file, and its power is a
#: float32 above 0. Chosen.
AXIS_FLOOR = np.float32(1e-20)
THOMSEN_P32, THOMSEN_ROOT, THIRD = np.float32(THOMSEN_P), np.float32(1 / THOMSEN_P), np.float32(1 / 3)


@fields(f4[:, :], f4[:, :], f4[:, :], f4[:])
class SplatColumns(NamedTuple):
    """Geometry of N splats, float32 columns as in `Splats`, for a kernel to read.

    Arrays that a parallel kernel fills must be arguments of their own: numba 0.68 takes writes to arrays out of a tuple
    for dead code and removes them.

    Attributes:
        center: (N, 3). scale: (N, 3). quat_xyzw: (N, 4). opacity: (N,).
    """

    center: Any
    scale: Any
    quat_xyzw: Any
    opacity: Any


@kernel()
def ellipsoid_area(a, b, c):
    """Surface area of an ellipsoid with semi-axes a, b, c, by Knud Thomsen's formula.

    Not all of them may be 0. A semi-axis counts as at least AXIS_FLOOR of the longest, so that needles have an area.
    """
    largest = max(a, b, c)
    smallest = min(a, b, c)
    middle = max(min(a, b), min(max(a, b), c))
    # Powers of ratios at most 1 stay in range, and in float32, where a power of a product of scales would not.
    y = max(np.float32(middle / largest), AXIS_FLOOR) ** THOMSEN_P32
    z = max(np.float32(smallest / largest), AXIS_FLOOR) ** THOMSEN_P32
    mean = ((y + z + y * z) * THIRD) ** THOMSEN_ROOT
    return 4 * math.pi * np.float64(largest) * np.float64(largest) * np.float64(mean)


@kernel(f4[:, :], f4[:, :], i8, parallel=True)
def find_bounds(center, scale, blocks):
    """The box of the centres, and the range of sizes.

    Args:
        center, scale: (N, 3) float32.
        blocks: ranges of splats to process in parallel; the result does not depend on it.

    Returns:
        low, high: (3,) float64 corners of the box.
        smallest, largest: size, 2 * max(scale).
    """
    n = len(center)
    low = np.full((blocks, 4), np.inf)
    high = np.full((blocks, 4), -np.inf)
    for c in prange(blocks):
        x0 = y0 = z0 = s0 = np.float32(np.inf)
        x1 = y1 = z1 = s1 = np.float32(-np.inf)
        for i in range(n * c // blocks, n * (c + 1) // blocks):
            x, y, z, s = center[i, 0], center[i, 1], center[i, 2], max(scale[i, 0], scale[i, 1], scale[i, 2])
            x0, y0, z0, s0 = min(x0, x), min(y0, y), min(z0, z), min(s0, s)
            x1, y1, z1, s1 = max(x1, x), max(y1, y), max(z1, z), max(s1, s)
        low[c, 0], low[c, 1], low[c, 2], low[c, 3] = x0, y0, z0, s0
        high[c, 0], high[c, 1], high[c, 2], high[c, 3] = x1, y1, z1, s1
    for c in range(1, blocks):
        for k in range(4):
            low[0, k] = min(low[0, k], low[c, k])
            high[0, k] = max(high[0, k], high[c, k])
    return low[0, :3], high[0, :3], 2 * low[0, 3], 2 * high[0, 3]
