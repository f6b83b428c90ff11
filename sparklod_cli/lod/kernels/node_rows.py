"""The quality builder's node rows from splats, splats from node rows, and Morton codes of nodes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel, prange, prefetch
from ...support.jit_types import f4, f8, fields, i8, out, u4
from .eigen import ROWS, decompose
from .geometry import LARGEST, SplatColumns, ellipsoid_area
from .merge import SCALE_FLOOR, covariance
from .pair_cost import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT, log_det
from .profile import is_needle, profile_of
from .sort import interleave

#: Bits per axis of a node's Morton code: 39 bits are sorted in four passes. Chosen.
CURVE_BITS = 13

#: Nodes whose merged splats are decomposed side by side, a sixth of them or more; results do not depend on it.
BLOCK = 256

#: Splats ahead whose columns are fetched, as they lie anywhere in them: then their cache misses overlap. Measured.
AHEAD = 8

#: Bound of colours in the cost of pairs, so that float32 holds their squares times a coverage. Chosen; far beyond any
#: display.
MAX_COLOR = np.float32(1e3)

#: Least coverage and least size of a leaf, in the builder's unit (squared), so that both have logarithms. Chosen.
LEAST = np.float32(1e-30)


@fields(f8[:], f8)
class Space(NamedTuple):
    """The builder's coordinates: (world - middle) / unit.

    Attributes:
        middle: (3,) float64, world units. unit: float64, world units.
    """

    middle: Any
    unit: Any


@kernel(u4[:], SplatColumns, f4[:, :], Space, out(f4[:, :]), out(f4[:]), parallel=True)
def fill_leaf_rows(index, splats, rgb, space, rows, size):
    """Fills row i from splat index[i].

    Args:
        index: (n,) uint32.
        splats: `SplatColumns`.
        rgb: (N, 3) float32 of the splats.
        space: `Space`.
        rows: node rows, see `pair_cost.py`; the first n are filled.
        size: (nodes,) float32; the first n are filled with the feature size, in units.
    """
    center, scale, quat, opacity = splats
    middle, unit = space
    for i in prange(len(index)):
        ahead = np.int64(index[min(i + AHEAD, len(index) - 1)])
        prefetch(center, ahead)
        prefetch(scale, ahead)
        prefetch(quat, ahead)
        prefetch(opacity, ahead)
        prefetch(rgb, ahead)
        splat = index[i]
        row = rows[i]
        a, b, c = scale[splat, 0] / unit, scale[splat, 1] / unit, scale[splat, 2] / unit
        x, y, z = np.float64(quat[splat, 0]), np.float64(quat[splat, 1]), np.float64(quat[splat, 2])
        xx, yy, zz, xy, xz, yz = covariance(a, b, c, x, y, z, np.float64(quat[splat, 3]))
        for k in range(3):
            row[CENTER + k] = (np.float64(center[splat, k]) - middle[k]) / unit
            row[COLOR + k] = min(max(rgb[splat, k], -MAX_COLOR), MAX_COLOR)
        row[COVARIANCE], row[COVARIANCE + 1], row[COVARIANCE + 2] = xx, yy, zz
        row[COVARIANCE + 3], row[COVARIANCE + 4], row[COVARIANCE + 5] = xy, xz, yz
        row[LOG_DET] = log_det(
            np.float32(xx), np.float32(yy), np.float32(zz), np.float32(xy), np.float32(xz), np.float32(yz)
        )
        covered = opacity[splat] * ellipsoid_area(a, b, c)
        row[COVERED] = row[WEIGHT] = max(covered, LEAST)
        row[DENSITY] = opacity[splat]
        size[i] = max(2 * (a + b + c) / 3, LEAST)


@kernel(inline=True)
def place_on_curve(rows, at, low, step):
    """The Morton code of the centre of row `at`; see `morton_keys`."""
    most = float((1 << CURVE_BITS) - 1)
    x = np.uint64(min(max((rows[at, CENTER] - low[0]) / step, 0.0), most))
    y = np.uint64(min(max((rows[at, CENTER + 1] - low[1]) / step, 0.0), most))
    z = np.uint64(min(max((rows[at, CENTER + 2] - low[2]) / step, 0.0), most))
    return interleave(x, y, z)


@kernel(f4[:, :], u4[:], f8[:], f8, parallel=True)
def morton_keys(rows, nodes, low, step):
    """Morton codes of nodes, of CURVE_BITS per axis; centres outside the curve's box are clamped to it.

    Args:
        rows: node rows.
        nodes: (n,) uint32 indices of rows.
        low: (3,) float64, the lowest corner of the box, units.
        step: edge of a cell, float64, units.

    Returns:
        (n,) uint64.
    """
    keys = np.empty(len(nodes), np.uint64)
    for i in prange(len(nodes)):
        keys[i] = place_on_curve(rows, nodes[i], low, step)
    return keys


@kernel(u4[:], i8, u4[:], f4[:, :], Space, out(f4[:, :]), out(f4[:, :]), out(f4[:, :]), out(f4[:]), parallel=True)
def fill_merged_splats(order, leaves, row, rows, space, center, scale, quat, opacity):
    """Fills the geometry of merged splats in final order; leaves are left as they are.

    Args:
        order: (M,) uint32, the node of each final index.
        leaves: number of leaves; nodes from there on are merged.
        row: (nodes - leaves,) uint32 row of each merged node.
        rows: node rows.
        space: `Space`.
        center, scale, quat, opacity: columns of M splats.
    """
    middle, unit = space
    n = len(order)
    for block in prange((n + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(n, block * BLOCK + BLOCK)
        moments = np.empty((ROWS, BLOCK), np.float64)
        found, source = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
        count = 0
        for i in range(begin, end):
            if order[i] >= leaves:
                found[count], source[count] = i, row[order[i] - leaves]
                for element in range(6):
                    moments[element, count] = rows[source[count], COVARIANCE + element]
                count += 1
        decompose(moments, np.int64(count))  # a literal 0 would be compiled as a type of its own
        for k in range(count):
            i = found[k]
            merged = rows[source[k]]
            needle = is_needle(moments[0, k], moments[1, k], moments[2, k])
            linear, spread = profile_of(np.float64(merged[DENSITY]), needle)
            opacity[i] = linear
            for axis in range(3):
                place = np.float64(merged[CENTER + axis]) * unit + middle[axis]
                center[i, axis] = min(max(place, -LARGEST), LARGEST)
                scale[i, axis] = min(max(math.sqrt(max(moments[axis, k], 0.0) / spread) * unit, SCALE_FLOOR), LARGEST)
            for part in range(4):
                quat[i, part] = moments[6 + part, k]
