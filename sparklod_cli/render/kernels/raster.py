"""Sorts splats into tiles and draws the tiles."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from .falloff import merged, plain, shifted
from .project import (
    ACROSS,
    ALONG,
    BLUE,
    COLUMNS,
    GREEN,
    HALF_HEIGHT,
    HALF_WIDTH,
    LEAST,
    LOG,
    OPACITY,
    POWER,
    RED,
    SHEAR,
    SLOPE,
    TALL,
    TILE,
    X,
    Y,
    index_of,
)

f32 = np.float32

#: Pixels of a row that are blended at once, the float32 of one AVX2 vector, and columns of as many pixels in a tile.
LANES = 8
BLOCKS = TILE // LANES

#: A tile is finished when no pixel has a transmittance of this or more, 1/40 of an 8-bit step. Chosen.
OPAQUE = f32(1e-4)

#: z^2 beyond which rows are left out, as a multiple of that where a splat ends: more than rounding can add. Chosen.
SLACK = f32(1.01)

#: Least square of a half width that is divided by, pixels squared. Chosen: far below a pixel.
LEAST_SQUARE = f32(1e-6)

#: Splats of a tile that are fetched and measured together before they are drawn; between two batches is a check for
#: OPAQUE. The rows of a tile's splats lie anywhere in memory: a processor fetches several at once where nothing that
#: has to be guessed stands between them. Measured: docs/decisions/2026-11-22-render-speed.md.
BATCH = 16


@kernel(parallel=True)
def sort_into_tiles(keys, boxes, across, down, blocks):
    """Lists the splats of each tile, in their order.

    Args:
        keys: (M,) uint64 of `project`, sorted, without NOT_DRAWN.
        boxes: (N, 4) int32 of it.
        across, down: numbers of tiles.
        blocks: ranges of splats to process in parallel; the result does not depend on it.

    Returns:
        start: (tiles + 1,) int64, where the splats of each tile begin.
        splats: (total,) int32 splats, from near to far.
    """
    tiles = across * down
    count = np.zeros((blocks, tiles), np.int32)
    n = len(keys)
    for block in prange(blocks):
        for k in range(n * block // blocks, n * (block + 1) // blocks):
            box = boxes[index_of(keys[k])]
            for y in range(box[2], box[3] + 1):
                for x in range(box[0], box[1] + 1):
                    count[block, y * across + x] += 1
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
            i = index_of(keys[k])
            box = boxes[i]
            for y in range(box[2], box[3] + 1):
                for x in range(box[0], box[1] + 1):
                    tile = y * across + x
                    splats[at[block, tile]] = i
                    at[block, tile] += 1
    return start, splats


@kernel(inline=True)
def blend(pixels, i, alpha, is_drawn, red, green, blue):
    """Blends a splat behind what a pixel has so far; branch-free, so that LLVM vectorizes over the pixels of a row.

    Colours are clamped to 1 after they are multiplied by alpha, as in an 8-bit picture.
    """
    alpha = alpha if is_drawn else f32(0)
    through = pixels[0, i]
    pixels[1, i] += through * min(alpha * red, f32(1))
    pixels[2, i] += through * min(alpha * green, f32(1))
    pixels[3, i] += through * min(alpha * blue, f32(1))
    pixels[0, i] = through - through * alpha


@kernel(inline=True)
def blend_column(pixels, row, x, first, last, design, least):
    """Blends a splat into a column of blocks.

    Args:
        pixels: (TILE, 4, LANES) float32: transmittance, red, green and blue.
        row: the splat, after `measure`.
        x: its centre from the middle of the column's first pixel, pixels.
        first, last: rows of pixels, the last excluded.
        design: merged splats have the falloff `shifted`, that of Spark's LoD design.
        least: float32, least alpha that is drawn.
    """
    y, along, shear, across, log, end = row[Y], row[ALONG], row[SHEAR], row[ACROSS], row[LOG], row[LEAST]
    d, power = row[OPACITY], row[POWER]
    red, green, blue = row[RED], row[GREEN], row[BLUE]
    if d <= 1:
        for line in range(first, last):
            dy = f32(line) - y
            middle, most = along * (x + shear * dy), log - across * dy * dy
            lanes = pixels[line]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                blend(lanes, i, plain(t), t >= end, red, green, blue)
    elif design:
        for line in range(first, last):
            dy = f32(line) - y
            middle, most = along * (x + shear * dy), log - across * dy * dy
            lanes = pixels[line]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                alpha = shifted(t, d)
                blend(lanes, i, alpha, (t >= end) & (alpha >= least), red, green, blue)
    else:
        for line in range(first, last):
            dy = f32(line) - y
            middle, most = along * (x + shear * dy), log - across * dy * dy
            lanes = pixels[line]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                alpha = merged(t, power)
                blend(lanes, i, alpha, (t >= end) & (alpha >= least), red, green, blue)


@kernel(inline=True)
def is_opaque(pixels):
    """Whether no pixel of a tile has a transmittance of OPAQUE or more."""
    most = np.zeros(LANES, np.float32)
    for block in range(BLOCKS):
        for line in range(TILE):
            for i in range(LANES):
                most[i] = max(most[i], pixels[block, line, 0, i])
    return most.max() < OPAQUE


@kernel(inline=True)
def measure(row, left, top, rows, columns, lines):
    """Rows of pixels in which a splat may be drawn, in each column of blocks of a tile; branch-free.

    The ellipse of an elongated splat fills half its box or less. Its side is lowest in the column at its lowest point,
    or else at the column's nearer edge.

    Args:
        row: the splat, a row of `screen`; X and Y are made those from the middle of the tile's first pixel.
        left, top: pixels left of and above the tile.
        rows, columns: of the tile's pixels.
        lines: (BLOCKS, 2) int32, filled; the last is excluded.
    """
    x, y = row[X] - f32(left) - f32(0.5), row[Y] - f32(top) - f32(0.5)
    row[X], row[Y] = x, y
    wide, high, slope, tall = row[HALF_WIDTH], row[HALF_HEIGHT], row[SLOPE], row[TALL]
    first, last = max(f32(0), np.ceil(y - high)), min(f32(rows), np.floor(y + high) + f32(1))
    lowest, narrow = row[SHEAR] * high, f32(1) / max(wide * wide, LEAST_SQUARE)
    for block in range(BLOCKS):
        near, far = f32(LANES * block) - x, min(f32(LANES * block + LANES), f32(columns)) - f32(1) - x
        low, up = min(max(lowest, near), far), min(max(-lowest, near), far)
        below = y + slope * low + tall * np.sqrt(max(SLACK - low * low * narrow, f32(0)))
        above = y + slope * up - tall * np.sqrt(max(SLACK - up * up * narrow, f32(0)))
        covers = (near <= wide) & (far >= -wide)
        lines[block, 0] = np.int32(min(max(first, above), f32(TILE)))
        lines[block, 1] = np.int32(max(min(last, below + f32(2)), f32(0))) if covers else np.int32(0)


@kernel(inline=True)
def draw_tile(screen, start, splats, tile, across, design, least, image):
    """Blends the splats of a tile, from near to far, see `draw_tiles`; returns where in `splats` it stopped."""
    height, width = image.shape[:2]
    left, top = tile % across * TILE, tile // across * TILE
    rows, columns = min(TILE, height - top), min(TILE, width - left)
    pixels = np.zeros((BLOCKS, TILE, 4, LANES), np.float32)
    fetched, lines = np.empty((BATCH, COLUMNS), np.float32), np.empty((BATCH, BLOCKS, 2), np.int32)
    for block in range(BLOCKS):
        for line in range(rows):
            for i in range(LANES):
                pixels[block, line, 0, i] = f32(1) if LANES * block + i < columns else f32(0)
    stop = start[tile + 1]
    for entry in range(start[tile], start[tile + 1], BATCH):
        count = min(BATCH, start[tile + 1] - entry)
        for k in range(count):
            found = screen[splats[entry + k]]
            for column in range(COLUMNS):
                fetched[k, column] = found[column]
        for k in range(count):
            measure(fetched[k], left, top, rows, columns, lines[k])
        for k in range(count):
            row = fetched[k]
            for block in range(BLOCKS):
                first, last = lines[k, block, 0], lines[k, block, 1]
                blend_column(pixels[block], row, row[X] - f32(LANES * block), first, last, design, least)
        if is_opaque(pixels):
            stop = min(entry + BATCH, stop)
            break
    for line in range(rows):
        for i in range(columns):
            lanes = pixels[i // LANES, line]
            image[top + line, left + i, 0] = lanes[1, i % LANES]
            image[top + line, left + i, 1] = lanes[2, i % LANES]
            image[top + line, left + i, 2] = lanes[3, i % LANES]
            image[top + line, left + i, 3] = f32(1) - lanes[0, i % LANES]
    return stop


@kernel(parallel=True, contract=True)
def draw_tiles(screen, start, splats, across, design, least, image, stop):
    """Blends the splats of each tile, from near to far.

    Args:
        screen: (N, COLUMNS) of `project`.
        start, splats: of `sort_into_tiles`.
        across: number of tiles in a row of them.
        design: merged splats have the falloff `shifted`, that of Spark's LoD design.
        least: float32, least alpha that is drawn.
        image: (height, width, 4) float32, filled: red, green and blue, premultiplied by alpha, and alpha.
        stop: (tiles,) int64, filled: up to where in `splats` each tile was drawn; it is opaque before the rest.
    """
    for tile in prange(len(stop)):
        stop[tile] = draw_tile(screen, start, splats, tile, across, design, least, image)
