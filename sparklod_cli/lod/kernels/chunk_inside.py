"""The order of families within their chunks."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import i4, i8, out
from .sort import AXIS_BITS, interleave

#: Bits of a key below its depth, and the depth from which on families keep the order that they have.
CODE_BITS = 57
DEEP = 63


@kernel(i8[:], i4[:], i4[:, :], i8, out(i4[:]), out(i4[:]), out(i4[:]), parallel=True)
def sort_within_chunks(bounds, parent, rank, axis_bits, sequence, chunk_of, depth):
    """Sorts the families of each chunk by the depth within it, then along a Morton curve.

    Neighbours in space have similar centres and colours, which makes them smaller to compress; parents stay before
    their children.

    Args:
        bounds: (C + 1,) int64, where each chunk begins in `sequence`, and the end.
        parent: (F,) int32, the family that has its parent; -1 for the root's.
        rank: (F, 3) int32, place of the parent's centre among all, along each axis.
        axis_bits: bits of the greatest rank.
        sequence: (F,) int32 families, parents first; reordered.
        chunk_of: (F,) int32 of no chunk's number; filled. Another thread may not have reached the parent's chunk yet.
        depth: (F,) int32, working memory.
    """
    up, down = np.uint64(max(AXIS_BITS - axis_bits, 0)), np.uint64(max(axis_bits - AXIS_BITS, 0))
    for chunk in prange(len(bounds) - 1):
        begin, end = bounds[chunk], bounds[chunk + 1]
        members = sequence[begin:end].copy()
        keys = np.empty(len(members), np.uint64)
        for i in range(len(members)):
            chunk_of[members[i]] = chunk
        for i in range(len(members)):
            family = members[i]
            above = parent[family]
            depth[family] = depth[above] + 1 if above >= 0 and chunk_of[above] == chunk else 0
            if depth[family] >= DEEP:
                keys[i] = (np.uint64(DEEP) << np.uint64(CODE_BITS)) | np.uint64(i)
                continue
            x, y, z = np.uint64(rank[family, 0]), np.uint64(rank[family, 1]), np.uint64(rank[family, 2])
            code = interleave((x << up) >> down, (y << up) >> down, (z << up) >> down)
            keys[i] = (np.uint64(depth[family]) << np.uint64(CODE_BITS)) | (
                code >> np.uint64(3 * AXIS_BITS - CODE_BITS)
            )
        order = np.argsort(keys)
        for i in range(len(members)):
            sequence[begin + i] = members[order[i]]
