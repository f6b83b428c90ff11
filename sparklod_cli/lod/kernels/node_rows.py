"""Splats into rows of state, rows of state into splats, and the order of rows along a curve."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...support.jit import kernel
from .eigen import ROWS, decompose
from .geometry import LARGEST, ellipsoid_area
from .merge import covariance
from .pair_cost import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT, log_det
from .profile import profile_of
from .sort import interleave

#: Bits an axis of the curve.
CURVE_BITS = 13

BLOCK = 64

#: Colours count for the choice of pairs no further than this, and nothing is smaller than LEAST, so that float32 holds
#: what they make.
BRIGHTEST, LEAST = np.float32(1e3), np.float32(1e-30)


@kernel(parallel=True)
def fill_state(index, center, scale, quat, opacity, rgb, middle, unit, state, size):
    """Row i of state from splat index[i].

    Args:
        index: (n,) uint32.
        center, scale, quat, opacity, rgb: columns of the splats.
        middle: (3,) float64 of the scene. unit: of length, float64.
        state: rows of `pairs.py`, the first n are filled.
        size: (rows,) float32, the first n are filled: how large the traversal sees them, in units.
    """
    for i in prange(len(index)):
        splat = index[i]
        row = state[i]
        a, b, c = scale[splat, 0] / unit, scale[splat, 1] / unit, scale[splat, 2] / unit
        x, y, z = np.float64(quat[splat, 0]), np.float64(quat[splat, 1]), np.float64(quat[splat, 2])
        xx, yy, zz, xy, xz, yz = covariance(a, b, c, x, y, z, np.float64(quat[splat, 3]))
        for k in range(3):
            row[CENTER + k] = (np.float64(center[splat, k]) - middle[k]) / unit
            row[COLOR + k] = min(max(rgb[splat, k], -BRIGHTEST), BRIGHTEST)
        row[COVARIANCE], row[COVARIANCE + 1], row[COVARIANCE + 2] = xx, yy, zz
        row[COVARIANCE + 3], row[COVARIANCE + 4], row[COVARIANCE + 5] = xy, xz, yz
        row[LOG_DET] = log_det(
            np.float32(xx), np.float32(yy), np.float32(zz), np.float32(xy), np.float32(xz), np.float32(yz)
        )
        covered = opacity[splat] * ellipsoid_area(a, b, c)
        row[COVERED] = row[WEIGHT] = max(covered, LEAST)
        row[DENSITY] = opacity[splat]
        size[i] = max(2 * (a + b + c) / 3, LEAST)


@kernel(parallel=True)
def curve_keys(state, nodes, low, step):
    """Places of nodes on a Morton curve of CURVE_BITS an axis; what is outside of it is at its edge.

    Args:
        state: rows of `pairs.py`. nodes: (n,) uint32 of it.
        low: (3,) float64 corner of its box. step: edge of its cells, float64.

    Returns:
        (n,) uint64.
    """
    keys = np.empty(len(nodes), np.uint64)
    most = float((1 << CURVE_BITS) - 1)
    for i in prange(len(nodes)):
        row = state[nodes[i]]
        x = np.uint64(min(max((row[CENTER] - low[0]) / step, 0.0), most))
        y = np.uint64(min(max((row[CENTER + 1] - low[1]) / step, 0.0), most))
        z = np.uint64(min(max((row[CENTER + 2] - low[2]) / step, 0.0), most))
        keys[i] = interleave(x, y, z)
    return keys


@kernel(parallel=True)
def fill_merged(order, leaves, state, middle, unit, center, scale, quat, opacity):
    """Columns of the merged nodes, in final order; rows of leaves are left alone.

    Args:
        order: (M,) uint32 row of state of each final index; those from `leaves` on are merged.
        state, middle, unit: see `fill_state`.
        center, scale, quat, opacity: of M splats.
    """
    n = len(order)
    for block in prange((n + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(n, block * BLOCK + BLOCK)
        moments = np.empty((ROWS, BLOCK), np.float64)
        found = np.empty(BLOCK, np.int64)
        count = 0
        for i in range(begin, end):
            if order[i] >= leaves:
                for element in range(6):
                    moments[element, count] = state[order[i], COVARIANCE + element]
                found[count] = i
                count += 1
        decompose(moments, np.int64(count))  # not as the literal 0, for which it would be compiled as well
        for k in range(count):
            i = found[k]
            row = state[order[i]]
            linear, spread = profile_of(np.float64(row[DENSITY]))
            opacity[i] = linear
            for axis in range(3):
                place = np.float64(row[CENTER + axis]) * unit + middle[axis]
                center[i, axis] = min(max(place, -LARGEST), LARGEST)
                scale[i, axis] = min(max(math.sqrt(max(moments[axis, k], 0.0) / spread) * unit, 1e-30), LARGEST)
            for part in range(4):
                quat[i, part] = moments[6 + part, k]
