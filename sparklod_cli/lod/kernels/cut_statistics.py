"""Statistics of a cut, and the number of nodes that it shares with another cut."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...model.falloff import DRAWN_AREA
from ...system.jit import f4, f8, fields, i4, i8, kernel, out, prefetch, u2, u4
from .cut import BUCKET_BITS, BUCKETS, LEAF, CutNodes
from .pixel_scale import NEAREST, NODES, ONE, VIEWS, ZERO

#: Columns of the counts of an instance: nodes of each kind; least, sum and largest depth; covered area.
SELECTED, LEAVES, FRONTIER, IN_FRUSTUM, OUTSIDE, BEHIND, DEPTH_MIN, DEPTH_SUM, DEPTH_MAX, AREA = range(10)
COUNTS = 10

#: Areas are summed as integers, in units of 1/1024 square pixel, so that the sum does not depend on the order.
AREA_PARTS = 1024

#: Nodes of a block: few enough for the processor's cache.
BLOCK_NODES = 512

#: Nodes ahead of the one being read that are fetched into the processor's cache. Chosen.
AHEAD = 64

#: All words of bits are cleared, not single bits, if there are fewer words than this many times the nodes. Chosen.
CLEAR_WORDS = 4


@fields(f4, f4, f4, f8)
class Screen(NamedTuple):
    """A camera's picture."""

    tan_x: Any  # tangents of half the fields of view
    tan_y: Any
    pixel_limit: Any  # float32, the pixel scale of a pixel
    area: Any  # square pixels, float64; no splat covers more


@kernel(NODES, i4[:], VIEWS, CutNodes, Screen, out(i8[:, :]), out(f4[:]), out(u2[:]), returns=i8)
def measure_cut(nodes, depths, views, cut, screen, counts, sizes, owners):
    """Count the nodes of a cut inside, outside and behind the frustum, and measure those inside; return their number.

    Args:
        depths: (nodes,) edges from the root, of all trees.
        cut: as `find_cut` fills it.
        counts: (instances, COUNTS) filled.
        sizes: (cut,) filled from the start with the feature sizes, pixels, of nodes inside the frustum; without NaN.
        owners: (cut,) filled with the instance of each of these.
    """
    node, limit, instance = cut
    counts[:] = 0
    counts[:, DEPTH_MIN] = 1 << 31
    x, y = np.empty(BLOCK_NODES, np.float32), np.empty(BLOCK_NODES, np.float32)
    z, size = np.empty(BLOCK_NODES, np.float32), np.empty(BLOCK_NODES, np.float32)
    found, begin = 0, 0
    while begin < len(node):
        # A block has successive nodes of an instance. They are first copied side by side, for vectorized arithmetic.
        number = instance[begin]
        end, last = begin + 1, min(begin + BLOCK_NODES, len(node))
        while end < last and instance[end] == number:
            end += 1
        row = counts[number]
        base = views[number].node_base
        leaves, frontier, total = 0, 0, 0
        least, most = row[DEPTH_MIN], row[DEPTH_MAX]
        for at in range(begin, end):
            ahead = base + node[min(at + AHEAD, len(node) - 1)]
            prefetch(nodes, ahead)
            prefetch(depths, ahead)
            index = base + node[at]
            record = nodes[index]
            to = at - begin
            x[to], y[to], z[to], size[to] = record.x, record.y, record.z, record.size
            leaves += record.child_count == 0
            frontier += limit[at] >= 0  # without nodes taken out by the queue
            depth = np.int64(depths[index])
            least, most = min(least, depth), max(most, depth)
            total += depth
        inside, behind, area = measure_block(x, y, z, size, end - begin, views[number], screen)
        row[SELECTED] += end - begin
        row[LEAVES] += leaves
        row[FRONTIER] += frontier
        row[DEPTH_MIN], row[DEPTH_MAX] = least, most
        row[DEPTH_SUM] += total
        row[BEHIND] += behind
        row[IN_FRUSTUM] += inside
        row[OUTSIDE] += end - begin - inside - behind
        row[AREA] += area
        for at in range(end - begin):
            sizes[found], owners[found] = size[at], number
            found += size[at] >= ZERO
        begin = end
    return found


@kernel()
def measure_block(x, y, z, size, count, view, screen):
    """Replace (BLOCK_NODES,) sizes by feature sizes in pixels; -1 for splats with centres not inside the frustum.

    Returns:
        number of splats inside the frustum, number behind the camera, area of those inside in 1 / AREA_PARTS square
        pixels.
    """
    tan_x, tan_y, pixel_limit, most_area = screen
    origin_x, origin_y, origin_z = view.origin_x, view.origin_y, view.origin_z
    forward_x, forward_y, forward_z = view.forward_x, view.forward_y, view.forward_z
    right_x, right_y, right_z = view.right_x, view.right_y, view.right_z
    up_x, up_y, up_z = view.up_x, view.up_y, view.up_z
    inside, behind, area = 0, 0, 0
    for at in range(count):
        dx, dy, dz = x[at] - origin_x, y[at] - origin_y, z[at] - origin_z
        ahead = dx * forward_x + dy * forward_y + dz * forward_z
        across = dx * right_x + dy * right_y + dz * right_z
        along = dx * up_x + dy * up_y + dz * up_z
        in_front = ahead > ZERO
        seen = in_front & (abs(across) <= tan_x * ahead) & (abs(along) <= tan_y * ahead)
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), NEAREST)
        pixels = size[at] / distance / pixel_limit
        size[at] = pixels if seen else -ONE
        covered = DRAWN_AREA * pixels * pixels
        covered = covered if covered < most_area else most_area
        area += np.int64(covered * AREA_PARTS) if seen else 0
        inside += seen
        behind += not in_front
    return inside, behind, area


@kernel(f4[:], i8[:], out(f4[:]))
def select(values, places, found):
    """Fill the order statistics of values, all at least 0, at ascending places."""
    # Values are counted in buckets by the upper halves of their bits; only the requested buckets are sorted.
    bits = values.view(np.int32)
    ends = np.zeros(BUCKETS, np.int32)
    for at in range(len(values)):
        ends[(bits[at] & ~LEAF) >> BUCKET_BITS] += 1
    total = 0
    for bucket in range(BUCKETS):
        total += ends[bucket]
        ends[bucket] = total
    asked, first = -1, 0
    some = values[:0]
    for entry in range(len(places)):
        bucket = np.searchsorted(ends, places[entry], side="right")
        if bucket != asked:
            asked, first = bucket, ends[bucket - 1] if bucket else 0
            some = np.empty(ends[bucket] - first + 1, np.float32)  # one more, to write without a branch
            count = 0
            for at in range(len(values)):
                some[count] = values[at]
                count += (bits[at] & ~LEAF) >> BUCKET_BITS == bucket
            some = np.sort(some[:count])
        found[entry] = some[places[entry] - first]


@kernel(out(u4[:]), out(u4[:]), i8[:], u4[:], u2[:], u4[:], u2[:], out(i8[:, :]))
def replace_drawn(drawn, before, base, node, instance, old_node, old_instance, counts):
    """Fill (instances, 2) counts: the nodes of a cut, and the nodes shared with the cut before.

    Args:
        drawn: words of zeros, a bit for each node of each instance; filled with the nodes of the cut.
        before: the same for the cut before; set to zeros.
        base: (instances,) the first bit of each.
        node, instance, old_node, old_instance: of the cut, and of the cut before.
    """
    counts[:] = 0
    one = np.uint32(1)
    begin = 0
    while begin < len(node):
        number = instance[begin]
        first = base[number]
        kept, end = np.int64(0), begin
        while end < len(node) and instance[end] == number:
            bit = first + node[end]
            kept += (before[bit >> 5] >> np.uint32(bit & 31)) & one
            drawn[bit >> 5] |= one << np.uint32(bit & 31)
            end += 1
        counts[number, 0] += end - begin
        counts[number, 1] += kept
        begin = end
    if len(before) < CLEAR_WORDS * len(old_node):
        before[:] = 0
        return
    for at in range(len(old_node)):
        before[(base[old_instance[at]] + old_node[at]) >> 5] = 0
