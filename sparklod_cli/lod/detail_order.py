"""How much is lost where a node stands for its leaves, whatever the camera: the order in which cuts refine nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import covariance, spark_size
from ..model.lod_tree import LodTree
from ..model.splats import Splats
from .plain_opacity import with_plain_opacity

#: Rows and columns, among xx xy xz yy yz zz, of the covariance on the planes xy, xz and yz, and the axes of these.
PLANES = ((0, 3, 1, 0, 1), (0, 5, 2, 0, 2), (3, 5, 4, 1, 2))

#: How far apart in the list of a node's children two may be for their overlap to count: all children of a tree of the
#: quality builder with up to 1.4 nodes a leaf. Nodes of other trees may have thousands. Chosen.
SIBLINGS = 15

#: Weight of opacity beside each of red, green and blue, as pictures may have any background. Chosen.
ALPHA_WEIGHT = 1.0

#: Standard deviation of the logarithms of the leaves' sizes from which on their number counts in full. Those of trained
#: scenes differ by 0.6 and more. Chosen.
SIZES_DIFFER = 0.3

#: Splats or pairs that are worked on at a time, so that their columns stay in the cache. Chosen.
BLOCK = 1 << 14

Column = NDArray[np.float64]


@np.errstate(over="ignore", invalid="ignore")  # where splats are as large as numbers are
def losses(nodes: Splats, tree: LodTree, parent: NDArray[np.int32]) -> Column:
    """(M,) float64 loss of each node if it is drawn instead of what is below it; no less than that of any node below.

    The loss of a node is the root of its picture error, times its feature size, times its leaves (to a power of at most
    1). The picture error is the squared difference between the picture of the node and that of its children, over red,
    green, blue and opacity, on the planes of the three axes; like the size squared, an area. The number of leaves is
    what says how much detail was here: where a scene has small splats close together, training put them there because
    pictures showed the need. Where all leaves have one size, as in a point cloud, it says nothing but how densely was
    sampled: the power is 0.

    Args:
        nodes: M splats of a tree in final order.
        tree: of them.
        parent: (M,) of each node, -1 of the root.
    """
    size = spark_size(nodes).astype(np.float64)
    loss = np.sqrt(picture_errors(with_plain_opacity(nodes), parent)) * size
    logs = np.log(np.maximum(size[tree.is_leaf], np.finfo(np.float64).tiny))
    power = min(1.0, float(logs.std()) / SIZES_DIFFER)
    leaves = tree.is_leaf.astype(np.float64)
    for family, starts, members in _families(tree):
        leaves[family] = np.add.reduceat(leaves[members], starts)
        own = np.nan_to_num(loss[family], nan=0.0) * leaves[family] ** power
        loss[family] = np.maximum(own, np.maximum.reduceat(loss[members], starts))
    return loss


def picture_errors(splats: Splats, parent: NDArray[np.int32]) -> Column:
    """(M,) squared difference between the picture of each splat and the sum of its children's, 0 for leaves.

    With Gaussians G of opacity times colour, it is the integral of (G - sum of G_c)^2 over each of three planes; the
    mean of them, divided by pi. Children more than SIBLINGS apart are taken for ones that do not overlap.

    Args:
        splats: M splats, opacities of at most 1.
        parent: (M,) of each, whose children are consecutive; -1 of the root.
    """
    count = len(splats)
    shape = np.empty((count, 6))
    for begin in range(0, count, BLOCK):
        some = slice(begin, begin + BLOCK)
        shape[some] = covariance(splats.scale[some], splats.quat_xyzw[some])
    node = np.arange(1, count)
    above = parent[1:].astype(np.int64)
    alone = _shared(splats, shape, np.arange(count), np.arange(count))
    error = np.bincount(above, alone[1:] - 2 * _shared(splats, shape, node, above), count)
    for step in range(1, SIBLINGS + 1):
        first = node[:-step][above[:-step] == above[step:]]
        if not first.size:
            break
        error += np.bincount(parent[first], 2 * _shared(splats, shape, first, first + step), count)
    inner = np.zeros(count, np.bool_)
    inner[above] = True
    return np.where(inner, np.maximum(error + alone, 0), 0.0)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # where splats have no extent, or are too far apart
def _shared(splats: Splats, shape: Column, first: NDArray[np.int64], second: NDArray[np.int64]) -> Column:
    """(n,) integrals of the product of two splats' pictures, in all channels; mean of the planes, divided by pi."""
    found = np.empty(len(first))
    for begin in range(0, len(first), BLOCK):
        a, b = first[begin : begin + BLOCK], second[begin : begin + BLOCK]
        color = np.einsum("ni,ni->n", splats.rgb[a], splats.rgb[b], dtype=np.float64) + ALPHA_WEIGHT
        high = splats.opacity[a].astype(np.float64) * splats.opacity[b] * color
        offset = splats.center[b].astype(np.float64) - splats.center[a]
        p, q = shape[a].T, shape[b].T
        total = np.zeros(len(a))
        for row, column, mixed, across, along in PLANES:
            xx, yy, xy = p[row] + q[row], p[column] + q[column], p[mixed] + q[mixed]
            own = np.maximum(p[row] * p[column] - p[mixed] ** 2, 0) * np.maximum(q[row] * q[column] - q[mixed] ** 2, 0)
            det = xx * yy - xy * xy
            x, y = offset[:, across], offset[:, along]
            power = (yy * x * x - 2 * xy * x * y + xx * y * y) / det
            total += np.where(det > 0, np.sqrt(own / det) * np.exp(-power / 2), 0.0)
        found[begin : begin + BLOCK] = high * total * (2 / 3)
    return found


def _families(tree: LodTree) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
    """From the deepest nodes up: inner nodes of one depth, where the children of each begin in a list, and the list."""
    depth = tree.depths()
    inner = np.flatnonzero(~tree.is_leaf)
    inner = inner[np.argsort(depth[inner], kind="stable")]
    found = []
    for family in np.split(inner, np.flatnonzero(np.diff(depth[inner])) + 1)[::-1]:
        count = tree.child_count[family].astype(np.int64)
        starts = np.cumsum(count) - count
        first = tree.child_start[family].astype(np.int64)
        if len(family):
            found.append((family, starts, np.repeat(first - starts, count) + np.arange(count.sum())))
    return found
