"""What a cut is like, and how it differs from another."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from .pixel_scale import NEAREST, ONE, ZERO

#: Columns of the counts of an instance.
SELECTED, LEAVES, FRONTIER, IN_FRUSTUM, OUTSIDE, BEHIND, LEVEL_MIN, LEVEL_SUM, LEVEL_MAX, AREA = range(10)
COUNTS = 10

#: Areas are added up in these parts of a square pixel: whole numbers have the same sum in any order.
AREA_PARTS = 1024

#: How far out a splat is drawn, in standard deviations, squared.
EXTENT_SQUARED = 8


@kernel(nogil=True)
def measure(nodes, level, views, node, limit, instance, tan_x, tan_y, pixel, most_area, counts, sizes):
    """Counts the nodes of a cut by where they are, and measures those in the picture.

    Args:
        nodes, views: as for `find_cut`.
        level: (nodes,) int32, links from the root, of all trees.
        node, limit, instance: of the cut, as `find_cut` fills them.
        tan_x, tan_y: tangents of half the fields of view.
        pixel: size over distance of a pixel.
        most_area: square pixels of the picture; no splat covers more.
        counts: (instances, COUNTS) int64, filled.
        sizes: (cut,) float32, filled: pixels on the screen of those in the picture, -1 for others. The size is that of
            the traversal, twice the mean standard deviation.
    """
    counts[:] = 0
    counts[:, LEVEL_MIN] = 1 << 31
    for at in range(len(node)):
        number = instance[at]
        view = views[number]
        index = view.node_base + node[at]
        counts[number, SELECTED] += 1
        counts[number, LEAVES] += nodes[index].child_count == 0
        counts[number, FRONTIER] += limit[at] >= 0  # not what the queue took out
        depth = level[index]
        counts[number, LEVEL_MIN] = min(counts[number, LEVEL_MIN], depth)
        counts[number, LEVEL_SUM] += depth
        counts[number, LEVEL_MAX] = max(counts[number, LEVEL_MAX], depth)
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
            size = nodes[index].size / distance / pixel
            sizes[at] = size
            area = np.float64(np.pi / 4 * EXTENT_SQUARED) * size * size
            counts[number, AREA] += np.int64((area if area < most_area else most_area) * AREA_PARTS)
        else:
            counts[number, OUTSIDE] += 1


@kernel(nogil=True)
def exchange(drawn, base, node, instance, old_node, old_instance, kept):
    """Replaces what is drawn, and counts what stays.

    Args:
        drawn: a bit for each node of each instance, uint32; those of the old cut are set, then those of the new one.
        base: (instances,) int64, the first bit of each.
        node, instance: of the new cut.
        old_node, old_instance: of the old cut.
        kept: (instances,) int64, filled: nodes of both.
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
