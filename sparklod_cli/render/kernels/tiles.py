"""Lists the splats of each tile of a picture."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange, prefetch
from ...support.jit_types import i2, i8, u8
from .project import index_of

#: Splats ahead whose boxes are fetched: with some notice, waits for memory overlap. Chosen.
AHEAD = 16


@kernel(u8[:], i2[:, :], i8, i8, i8, parallel=True)
def sort_into_tiles(keys, boxes, across, down, blocks):
    """Lists the splats of each tile, in their order.

    Args:
        keys: (M,) uint64 of `project`, sorted, without NOT_DRAWN.
        boxes: (N, 4) int16 of it.
        across, down: numbers of tiles.
        blocks: ranges of splats to process in parallel; the result does not depend on it.

    Returns:
        start: (tiles + 1,) int64, where the splats of each tile begin.
        splats: (total,) int32 splats, from near to far.
    """
    tiles = across * down
    count = np.zeros((blocks, tiles), np.int32)
    n = len(keys)
    sorted_boxes, words = np.empty((n, 4), np.int16), boxes.reshape(-1)
    for block in prange(blocks):
        last = n * (block + 1) // blocks
        for k in range(n * block // blocks, last):
            if k + AHEAD < last:
                prefetch(words, 4 * index_of(keys[k + AHEAD]))
            box = boxes[np.uint64(index_of(keys[k]))]
            left, right, top, bottom = np.int64(box[0]), np.int64(box[1]), np.int64(box[2]), np.int64(box[3])
            near = sorted_boxes[np.uint64(k)]
            near[0], near[1], near[2], near[3] = left, right, top, bottom
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    count[block, np.uint64(y * across + x)] += 1
    start = np.empty(tiles + 1, np.int64)
    at = np.empty((blocks, tiles), np.int64)
    total = 0
    for tile in range(tiles):
        start[tile] = total
        for block in range(blocks):
            at[block, tile] = total
            total += count[block, tile]
    start[tiles] = total
    splats = np.empty(total, np.int32)
    for block in prange(blocks):
        for k in range(n * block // blocks, n * (block + 1) // blocks):
            i = np.int32(index_of(keys[k]))
            box = sorted_boxes[np.uint64(k)]
            left, right, top, bottom = np.int64(box[0]), np.int64(box[1]), np.int64(box[2]), np.int64(box[3])
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    tile = np.uint64(y * across + x)
                    to = at[block, tile]
                    at[block, tile] = to + 1
                    splats[np.uint64(to)] = i
    return start, splats
