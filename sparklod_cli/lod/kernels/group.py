"""Levels and regions of the quick builder: the sort keys of splats, and nodes in a box."""

from __future__ import annotations

import math

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, f8, i8, u4
from .pair_cost import CENTER
from .sort import morton_code


@kernel(f4[:, :], f4[:, :], f8[:], f8, i8[:], i8, parallel=True)
def level_keys(center, scale, steps, grid, low, cell_bits):
    """Sort keys that order splats by level and, within a level, along a Morton curve.

    Args:
        center, scale: (n, 3) float32.
        steps: (L,) float64, the cell edge of each level, a rising geometric series. The last is at least the largest
            size; splats smaller than the first belong to it.
        grid: edge of the cells of the curve, float64.
        low: (3,) int64, the lowest cell of the curve.
        cell_bits: number of bits for the curve; the level's bits are above them.

    Returns:
        keys: (n,) uint64.
        levels: (n,) int32, indices into `steps`.
    """
    n = len(scale)
    keys = np.empty(n, np.uint64)
    levels = np.empty(n, np.int32)
    start = math.log(steps[0])
    per_level = (len(steps) - 1) / (math.log(steps[-1]) - start)
    for i in prange(n):
        size = 2 * np.float64(max(scale[i, 0], scale[i, 1], scale[i, 2]))
        level = min(max(np.int64(math.ceil((math.log(size) - start) * per_level)), 0), len(steps) - 1)
        # The logarithm is rounded; the table of steps defines the level.
        while level > 0 and size <= steps[level - 1]:
            level -= 1
        while size > steps[level]:
            level += 1
        levels[i] = level
        x, y, z = np.float64(center[i, 0]), np.float64(center[i, 1]), np.float64(center[i, 2])
        keys[i] = morton_code(x, y, z, grid, low, np.uint64(0)) | (np.uint64(levels[i]) << np.uint64(cell_bits))
    return keys, levels


@kernel(u4[:], f4[:, :], f4[:], f4[:])
def split_box(nodes, geometry, below, above):
    """Separates nodes whose centres lie between two corners from the others.

    Args:
        nodes: (n,) uint32 rows of geometry.
        geometry: node rows of `pair_cost.py`.
        below, above: (3,) float32; centres between them on all axes are inside.

    Returns:
        inside, outside: uint32, the nodes in their order.
    """
    inside, outside = np.empty(len(nodes), np.uint32), np.empty(len(nodes), np.uint32)
    n = m = 0
    for i in range(len(nodes)):
        x, y, z = geometry[nodes[i], CENTER], geometry[nodes[i], CENTER + 1], geometry[nodes[i], CENTER + 2]
        if below[0] < x < above[0] and below[1] < y < above[1] and below[2] < z < above[2]:
            inside[n] = nodes[i]
            n += 1
        else:
            outside[m] = nodes[i]
            m += 1
    return inside[:n], outside[:m].copy()
