"""Statistics of a cut, and the nodes that it shares with another."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel
from .pixel_scale import NEAREST, ONE, ZERO

#: Columns of the counts of an instance: nodes of each kind; least, sum and largest of their depths; area covered.
SELECTED, LEAVES, FRONTIER, IN_FRUSTUM, OUTSIDE, BEHIND, DEPTH_MIN, DEPTH_SUM, DEPTH_MAX, AREA = range(10)
COUNTS = 10

#: Areas are summed as whole numbers of 1/1024 square pixel, so that the sum does not depend on the order.
AREA_PARTS = 1024

#: Radius of a drawn splat in standard deviations, squared: Spark's `maxStdDev` is sqrt(8).
EXTENT_SQUARED = 8


class Screen(NamedTuple):
    """A camera's picture.

    Attributes:
        tan_x, tan_y: float32 tangents of half the fields of view.
        pixel_limit: float32, the pixel scale of a pixel.
        area: square pixels, float64; no splat covers more.
    """

    tan_x: Any
    tan_y: Any
    pixel_limit: Any
    area: Any


@kernel(nogil=True)
def measure_cut(nodes, depths, views, cut, screen, counts, sizes):
    """Counts the nodes of a cut by where their centres are, and measures those inside the frustum.

    Args:
        nodes: `NODE` of all trees.
        depths: (nodes,) int32, edges from the root, of all trees.
        views: (instances,) `VIEW`.
        cut: `CutNodes`, as `find_cut` fills it.
        screen: `Screen`.
        counts: (instances, COUNTS) int64, filled.
        sizes: (cut,) float32, filled with the feature size, in pixels on the screen, of nodes inside the frustum, and
            -1 for others.
    """
    node, limit, instance = cut
    tan_x, tan_y, pixel_limit, most_area = screen
    counts[:] = 0
    counts[:, DEPTH_MIN] = 1 << 31
    for at in range(len(node)):
        number = instance[at]
        view = views[number]
        index = view.node_base + node[at]
        counts[number, SELECTED] += 1
        counts[number, LEAVES] += nodes[index].child_count == 0
        counts[number, FRONTIER] += limit[at] >= 0  # not what the queue has taken out
        depth = depths[index]
        counts[number, DEPTH_MIN] = min(counts[number, DEPTH_MIN], depth)
        counts[number, DEPTH_SUM] += depth
        counts[number, DEPTH_MAX] = max(counts[number, DEPTH_MAX], depth)
        dx, dy, dz = nodes[index].x - view.origin_x, nodes[index].y - view.origin_y, nodes[index].z - view.origin_z
        ahead = dx * view.forward_x + dy * view.forward_y + dz * view.forward_z
        across = dx * view.right_x + dy * view.right_y + dz * view.right_z
        along = dx * view.up_x + dy * view.up_y + dz * view.up_z
        sizes[at] = -ONE
        if not ahead > ZERO:
            counts[number, BEHIND] += 1
        elif abs(across) <= tan_x * ahead and abs(along) <= tan_y * ahead:
            counts[number, IN_FRUSTUM] += 1
            distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), NEAREST)
            size = nodes[index].size / distance / pixel_limit
            sizes[at] = size
            area = np.float64(np.pi / 4 * EXTENT_SQUARED) * size * size
            counts[number, AREA] += np.int64((area if area < most_area else most_area) * AREA_PARTS)
        else:
            counts[number, OUTSIDE] += 1


@kernel(nogil=True)
def replace_drawn(drawn, base, node, instance, old_node, old_instance, kept):
    """Replaces the old cut by the new one in a set of drawn nodes, and counts the nodes of both.

    Args:
        drawn: uint32 words with a bit for each node of each instance: the old cut on entry, the new one on return.
        base: (instances,) int64, the first bit of each.
        node, instance: of the new cut.
        old_node, old_instance: of the old cut.
        kept: (instances,) int64, filled with the number of nodes in both cuts.
    """
    kept[:] = 0
    one = np.uint32(1)
    for at in range(len(node)):
        bit = base[instance[at]] + node[at]
        kept[instance[at]] += (drawn[bit >> 5] >> np.uint32(bit & 31)) & one
    for at in range(len(old_node)):
        drawn[(base[old_instance[at]] + old_node[at]) >> 5] = 0
    for at in range(len(node)):
        bit = base[instance[at]] + node[at]
        drawn[bit >> 5] |= one << np.uint32(bit & 31)
