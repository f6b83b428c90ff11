"""Merges groups of splats by moment matching: the merged splat has their weighted mean and covariance.

Weights, moments and the eigen-decomposition are in float64, as float32 has too few digits for a mean of centres 1e7
units from the origin, and too small a range for squares of scales near 1e-30.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...model import gaussian
from ...model.gaussian import MAX_OPACITY, MIN_OPACITY
from ...support.jit import kernel
from .eigen import ROWS, decompose
from .geometry import CENTER, LARGEST, OPACITY, QUAT, SCALE, WIDTH, ellipsoid_area

#: Least scale of a merged splat, world units: a scale of 0 has no logarithm, which PLY and SPZ store. Chosen.
SCALE_FLOOR = 1e-30

#: Groups merged together: gathered, summed, then decomposed side by side; results do not depend on it.
BLOCK = 64

rotation_matrix = kernel(inline=True)(gaussian.rotation_matrix)


@kernel()
def covariance(a, b, c, x, y, z, w):
    """xx, yy, zz, xy, xz, yz of R diag(a^2, b^2, c^2) R^T, of scales a, b, c and a unit quaternion in float64."""
    a, b, c = a * a, b * b, c * c
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(x, y, z, w, 1.0)
    return (
        r00 * r00 * a + r01 * r01 * b + r02 * r02 * c,
        r10 * r10 * a + r11 * r11 * b + r12 * r12 * c,
        r20 * r20 * a + r21 * r21 * b + r22 * r22 * c,
        r00 * r10 * a + r01 * r11 * b + r02 * r12 * c,
        r00 * r20 * a + r01 * r21 * b + r02 * r22 * c,
        r10 * r20 * a + r11 * r21 * b + r12 * r22 * c,
    )


@kernel()
def sum_moments(row, weight, begin, end, merged, moments, column):
    """Weighted mean and covariance of the rows `begin` to `end`.

    Args:
        row, weight: rows of `geometry.py` and their weights.
        begin, end: the range of rows.
        merged: a row of geometry; its centre is set to the mean.
        moments: (6 or more, columns) float64; rows 0 to 5 of `column` are set to xx, yy, zz, xy, xz, yz.
        column: index of the group in `moments`.

    Returns:
        the sum of the weights.
    """
    total = x = y = z = 0.0
    for k in range(begin, end):
        w = weight[k]
        total += w
        x += w * row[k, CENTER]
        y += w * row[k, CENTER + 1]
        z += w * row[k, CENTER + 2]
    x, y, z = x / total, y / total, z / total
    xx = yy = zz = xy = xz = yz = 0.0
    for k in range(begin, end):
        cxx, cyy, czz, cxy, cxz, cyz = covariance(
            np.float64(row[k, SCALE]),
            np.float64(row[k, SCALE + 1]),
            np.float64(row[k, SCALE + 2]),
            np.float64(row[k, QUAT]),
            np.float64(row[k, QUAT + 1]),
            np.float64(row[k, QUAT + 2]),
            np.float64(row[k, QUAT + 3]),
        )
        w = weight[k] / total
        dx, dy, dz = row[k, CENTER] - x, row[k, CENTER + 1] - y, row[k, CENTER + 2] - z
        xx += w * (cxx + dx * dx)
        yy += w * (cyy + dy * dy)
        zz += w * (czz + dz * dz)
        xy += w * (cxy + dx * dy)
        xz += w * (cxz + dx * dz)
        yz += w * (cyz + dy * dz)
    merged[CENTER], merged[CENTER + 1], merged[CENTER + 2] = x, y, z
    moments[0, column], moments[1, column], moments[2, column] = xx, yy, zz
    moments[3, column], moments[4, column], moments[5, column] = xy, xz, yz
    return total


@kernel(parallel=True)
def merge_groups(nodes, first, geometry, weight, base):
    """Merges each group of nodes into one, by moments weighted with opacity * area.

    A merged node's opacity is the sum of the weights over its area, so that it covers about as much as the group.

    Args:
        nodes: (C,) uint32 rows of geometry, the members of all groups.
        first: (G + 1,) where each group begins in `nodes`.
        geometry: rows of `geometry.py`; rows base .. base + G are filled.
        weight: (len(geometry),) float64, opacity * area of each row; the same rows are filled.
        base: the first row to fill.
    """
    groups = len(first) - 1
    for block in prange((groups + BLOCK - 1) // BLOCK):
        block_begin, block_end = block * BLOCK, min(groups, block * BLOCK + BLOCK)
        offset = first[block_begin]
        # Members are copied first so that their cache misses overlap; the arithmetic below would wait for each in turn.
        row = np.empty((first[block_end] - offset, WIDTH), np.float32)
        row_weight = np.empty(len(row), np.float64)
        for k in range(len(row)):
            for column in range(WIDTH):
                row[k, column] = geometry[nodes[offset + k], column]
        for k in range(len(row)):
            row_weight[k] = weight[nodes[offset + k]]
        moments = np.empty((ROWS, BLOCK), np.float64)
        total_weight = np.empty(BLOCK, np.float64)
        for g in range(block_begin, block_end):
            total_weight[g - block_begin] = sum_moments(
                row, row_weight, first[g] - offset, first[g + 1] - offset, geometry[base + g], moments, g - block_begin
            )
        decompose(moments, block_end - block_begin)
        for k in range(block_end - block_begin):
            made = base + block_begin + k
            a = min(max(math.sqrt(max(moments[0, k], 0.0)), SCALE_FLOOR), LARGEST)
            b = min(max(math.sqrt(max(moments[1, k], 0.0)), SCALE_FLOOR), LARGEST)
            c = min(max(math.sqrt(max(moments[2, k], 0.0)), SCALE_FLOOR), LARGEST)
            geometry[made, SCALE], geometry[made, SCALE + 1], geometry[made, SCALE + 2] = a, b, c
            for i in range(4):
                geometry[made, QUAT + i] = moments[6 + i, k]
            area = ellipsoid_area(a, b, c)
            opacity = min(max(total_weight[k] / area, MIN_OPACITY), MAX_OPACITY)
            geometry[made, OPACITY] = opacity
            weight[made] = opacity * area
