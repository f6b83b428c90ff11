"""Node rows from splats, merged splats from node rows, Morton codes of nodes, and columns in the final order.

Arrays that kernels share: `rows`, node rows (see `pair_merge.py`); nodes from `leaves` on are merged; `row` (nodes -
leaves,), the row of each merged node; `order` (M,), the node of each final index; `index` (n,), the input splat of each
leaf.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...system.jit import f4, f8, fields, i8, kernel, out, prefetch, u2, u4, u8
from .geometry import (
    LARGEST,
    ROWS,
    SCALE_FLOOR,
    SplatColumns,
    covariance,
    decompose,
    ellipsoid_area,
    is_needle,
    profile_of,
)
from .pair_merge import CENTER, COLOR, COVARIANCE, COVERED, DENSITY, LOG_DET, WEIGHT, log_det
from .sort import interleave

#: Bits per axis of a node's Morton code: 39 bits are sorted in four passes. Chosen.
CURVE_BITS = 13

#: Nodes of a block, of whose merged splats, a sixth or more, the covariances are decomposed side by side; results do
#: not depend on it.
BLOCK = 256

#: Distance of prefetched splats, which lie anywhere in the columns, so that cache misses overlap. Measured.
AHEAD = 8

#: Bound of colours in the cost of pairs, so that float32 holds their squares times a coverage. Chosen: far beyond
#: displayed colours.
MAX_COLOR = np.float32(1e3)

#: Least coverage and least size of a leaf, in the builder's unit (squared), so that both have logarithms. Chosen.
LEAST = np.float32(1e-30)

#: Distance of prefetched leaves in `fill_leaves`. Measured.
LEAVES_AHEAD = 16

#: float32 of a cache line.
LINE = 16


@fields(f8[:], f8)
class Space(NamedTuple):
    """The builder's coordinates: (world - middle) / unit."""

    middle: Any  # (3,) float64, world units
    unit: Any  # float64, world units


@kernel(i8, u4[:], SplatColumns, f4[:, :], Space, out(f4[:, :]), out(f4[:]), ranges=True)
def fill_leaf_rows(start, stop, index, splats, rgb, space, rows, size):
    """Fill row i, and its feature size in units, from splat index[i]; `rgb` (N, 3) are the colours of the splats."""
    center, scale, quat, opacity = splats
    middle, unit = space
    for i in range(start, stop):
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


@kernel(i8, u4[:], u4[:], i8, out(u4[:]), ranges=True)
def fill_rows_of(start, stop, nodes, row, leaves, found):
    """Fill the numbers of the rows of nodes; leaf k has row k."""
    for i in range(start, stop):
        node = nodes[np.uint64(i)]
        found[np.uint64(i)] = node if node < leaves else row[np.uint64(node - leaves)]


@kernel(i8, f4[:, :], u4[:], f8[:], f8, out(u8[:]), ranges=True)
def fill_morton_keys(start, stop, rows, nodes, low, step, keys):
    """Fill the Morton codes of nodes, with CURVE_BITS per axis; centres outside the curve's box are clamped to it.

    `low` (3,) is the lowest corner of the box and `step` the edge of a cell, units; only the first columns of `rows`,
    the centre, are read.
    """
    most = float((1 << CURVE_BITS) - 1)
    for i in range(start, stop):
        at = nodes[i]
        x = np.uint64(min(max((rows[at, CENTER] - low[0]) / step, 0.0), most))
        y = np.uint64(min(max((rows[at, CENTER + 1] - low[1]) / step, 0.0), most))
        z = np.uint64(min(max((rows[at, CENTER + 2] - low[2]) / step, 0.0), most))
        keys[i] = interleave(x, y, z)


@kernel(i8, u4[:], i8, u4[:], f4[:, :], Space, out(f4[:, :]), out(f4[:, :]), out(f4[:, :]), out(f4[:]), ranges=True)
def fill_merged_splats(start, stop, order, leaves, row, rows, space, center, scale, quat, opacity):
    """Fill the geometry of merged splats into columns of M splats in final order; rows of leaves do not change."""
    middle, unit = space
    moments = np.empty((ROWS, BLOCK), np.float64)
    found, source = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    for begin in range(start, stop, BLOCK):
        count = np.int64(0)
        for i in range(begin, min(stop, begin + BLOCK)):
            if order[i] >= leaves:
                found[count], source[count] = i, row[order[i] - leaves]
                for element in range(6):
                    moments[element, count] = rows[source[count], COVARIANCE + element]
                count += 1
        decompose(moments, count)
        for k in range(count):
            i = found[k]
            merged = rows[source[k]]
            needle = is_needle(moments[0, k], moments[1, k], moments[2, k])
            linear, spread = profile_of(np.float64(merged[DENSITY]), needle)
            opacity[i] = linear
            for axis in range(3):
                place = np.float64(merged[CENTER + axis]) * unit + middle[axis]
                center[i, axis] = min(max(place, -LARGEST), LARGEST)
                axis_scale = math.sqrt(max(moments[axis, k], 0.0) / spread) * unit
                scale[i, axis] = min(max(axis_scale, SCALE_FLOOR), LARGEST)
            for part in range(4):
                quat[i, part] = moments[6 + part, k]


@kernel(i8, u4[:], u4[:], f4[:, :], out(f4[:, :]), ranges=True)
def fill_leaves(start, stop, order, index, column, out):
    """Fill the leaves of `out` (M, J), in final order, from `column` (n, J); rows of merged nodes do not change."""
    n, width, flat = len(order), column.shape[1], column.reshape(-1)
    for i in range(start, stop):
        ahead = order[min(i + LEAVES_AHEAD, n - 1)]
        if ahead < len(index):
            begin = np.int64(index[ahead]) * width
            for word in range(begin, begin + width, LINE):
                prefetch(flat, word)
            prefetch(flat, begin + width - 1)
        if order[i] < len(index):
            j = index[order[i]]
            for k in range(width):
                out[i, k] = column[j, k]


@kernel(
    (i8, u4[:], u4[:], u2[:], u4[:], f4[:], out(f4[:, :])),
    (i8, u4[:], u4[:], u2[:], u4[:], f8[:], out(f4[:, :])),
    ranges=True,
)
def merge_colors(start, stop, parents, child_start, child_count, order, weight, color):
    """Fill the colours of nodes with the weighted means of their children's, which must be filled already.

    Args:
        parents: (G,) final indices of the nodes.
        child_start, child_count: of the whole tree.
        weight: (nodes,) of each node.
        color: (M, J) in final order; rows `parents` are filled.
    """
    width = color.shape[1]
    total = np.empty(width, np.float64)
    for g in range(start, stop):
        node = parents[g]
        total_weight = 0.0
        for k in range(width):
            total[k] = 0.0
        begin = np.int64(child_start[node])
        for child in range(begin, begin + child_count[node]):
            w = np.float64(weight[order[child]])
            total_weight += w
            for k in range(width):
                total[k] += w * color[child, k]
        for k in range(width):
            color[node, k] = total[k] / total_weight
