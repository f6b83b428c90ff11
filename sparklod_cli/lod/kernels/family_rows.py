"""Columns of families, the children of one node each, in the order in which they are arranged for streaming."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, i4, i8, out, u2, u4
from .pixel_scale import NODES

#: Sign bit of a float32.
SIGN = np.uint32(1 << 31)


@kernel(u4[:], i4[:], parallel=True)
def parents_in(order, parent):
    """Return the (F,) int32 place of each family's parent, -1 without one, where families are in an order.

    Args:
        order: (F,) uint32 families.
        parent: (F,) int32 the parent of each family, -1 without one.
    """
    place, found = np.empty(len(order), np.int32), np.empty(len(order), np.int32)
    for i in prange(len(order)):
        place[order[i]] = i
    for i in prange(len(order)):
        above = parent[order[i]]
        found[i] = -1 if above < 0 else place[above]
    return found


@kernel(f4[:, :], u4[:], i8, parallel=True)
def axis_keys(center, order, axis):
    """Return (F,) uint64 keys of 32 bits, in the order of the centres along an axis, where families are in an order.

    Args:
        center: (F, 3) float32.
        order: (F,) uint32 families.
        axis: 0, 1 or 2.
    """
    keys = np.empty(len(order), np.uint64)
    for i in prange(len(order)):
        bits = np.float32(center[order[i], axis]).view(np.uint32)
        keys[i] = ~bits if bits & SIGN else bits | SIGN
    return keys


@kernel(u4[:], i8, out(i4[:, :]), parallel=True)
def fill_ranks(by_place, axis, rank):
    """Fill the ranks of families along an axis, in a (F, 3) int32 table, from the (F,) uint32 families in its order."""
    for i in prange(len(by_place)):
        rank[by_place[i], axis] = i


@kernel(u4[:], f4[:, :], f4[:], u2[:], out(NODES), parallel=True)
def fill_parents(order, center, size, count, nodes):
    """Fill the parents of families in an order; `child_start`, which is not read, is left as it is.

    Args:
        order: (F,) uint32 families.
        center: (F, 3) float32 of their parents.
        size: (F,) float32 feature sizes of their parents.
        count: (F,) uint16 number of children.
        nodes: (F,) `pixel_scale.NODE`, filled.
    """
    for i in prange(len(order)):
        family, node = order[i], nodes[i]
        node.x, node.y, node.z = center[family, 0], center[family, 1], center[family, 2]
        node.size, node.child_count = size[family], count[family]
