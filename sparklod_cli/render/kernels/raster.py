"""Lists the splats of each tile of a picture, and draws the tiles; draws discs and counts fragments."""

from __future__ import annotations

import math

import numpy as np

from ...model.falloff import alpha_at, merged, plain, shifted
from ...system.jit import b1, f4, i2, i4, i8, kernel, out, prefetch, u8
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
    exponent,
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
#: OPAQUE. The rows of a tile's splats lie anywhere in memory: a processor fetches several at once if no
#: unpredictable branch is between them. Measured: benchmarks/notes/rasterizer.md.
BATCH = 16

#: Rows of LANES pixels that a batch may have to be blended into, and one column that is written beyond the last.
ROWS = (BATCH * BLOCKS + 1) * TILE

#: Entries of a list of rows of pixels, see `list_rows`: the row's place in its tile, and the batch's splat blended into
#: it; and MIDDLE and MOST of the exponent t of that splat's falloff: i pixels right of the row's first,
#: t = MOST - (ALONG i - MIDDLE)^2.
PLACE, SPLAT = range(2)
MIDDLE, MOST = range(2)

#: Splats ahead whose boxes are fetched: with some notice, waits for memory overlap. Chosen.
AHEAD = 16


@kernel(i8, u8[:], i2[:, :], i8, out(i2[:, :]), out(i4[:, :]), ranges=True)
def count_in_tiles(begin, end, keys, boxes, across, sorted_boxes, counts):
    """Gather the boxes of splats in the order of their keys, and count those that overlap each tile.

    Args:
        begin, end: blocks of splats, of `len(counts)` of about one size.
        keys: (M,) of `project`, sorted, without NOT_DRAWN.
        across: number of tiles in a row of them.
        counts: (blocks, tiles) added to: for each block, the splats of each tile.
    """
    words = boxes.reshape(-1)
    for block in range(begin, end):
        last = len(keys) * (block + 1) // len(counts)
        for k in range(len(keys) * block // len(counts), last):
            if k + AHEAD < last:
                prefetch(words, 4 * index_of(keys[k + AHEAD]))
            box = boxes[np.uint64(index_of(keys[k]))]
            left, right, top, bottom = np.int64(box[0]), np.int64(box[1]), np.int64(box[2]), np.int64(box[3])
            near = sorted_boxes[np.uint64(k)]
            near[0], near[1], near[2], near[3] = left, right, top, bottom
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    counts[block, np.uint64(y * across + x)] += 1


@kernel(i8, u8[:], i2[:, :], i8, out(i8[:, :]), out(i4[:]), ranges=True)
def list_in_tiles(begin, end, keys, sorted_boxes, across, at, splats):
    """List the splats of each tile, in the order of their keys; for the other arguments see `count_in_tiles`.

    Args:
        at: (blocks, tiles) where the splats of each block begin in the list of each tile; changed.
        splats: (total,) filled: the lists, one after another.
    """
    for block in range(begin, end):
        for k in range(len(keys) * block // len(at), len(keys) * (block + 1) // len(at)):
            i = np.int32(index_of(keys[k]))
            box = sorted_boxes[np.uint64(k)]
            left, right, top, bottom = np.int64(box[0]), np.int64(box[1]), np.int64(box[2]), np.int64(box[3])
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    tile = np.uint64(y * across + x)
                    to = at[block, tile]
                    at[block, tile] = to + 1
                    splats[np.uint64(to)] = i


@kernel(inline=True)
def blend(lanes, i, alpha, is_drawn, red, green, blue):
    """Blend a splat behind the splats of a pixel; branch-free, so that LLVM vectorizes over the pixels of a row.

    Colours are clamped to 1 after they are multiplied by alpha, as in an 8-bit picture.
    """
    alpha = alpha if is_drawn else f32(0)
    through = lanes[0, i]
    lanes[1, i] += through * min(alpha * red, f32(1))
    lanes[2, i] += through * min(alpha * green, f32(1))
    lanes[3, i] += through * min(alpha * blue, f32(1))
    lanes[0, i] = through - through * alpha


@kernel(inline=True)
def list_rows(splats, k, lines, rows, terms, end):
    """List the rows of pixels in which a splat may be drawn; branch-free, as their number cannot be foreseen.

    Args:
        splats: (COLUMNS, BATCH) splats of a batch, after `measure`; this is the one in column `k`.
        rows, terms: (2, ROWS) PLACE and SPLAT, and MIDDLE and MOST, filled from `end` on, and up to TILE columns beyond
            the last row.

    Returns:
        the end of the list.
    """
    x, y, along, shear = splats[X, k], splats[Y, k], splats[ALONG, k], splats[SHEAR, k]
    across, log = splats[ACROSS, k], splats[LOG, k]
    for block in range(BLOCKS):
        first, last = lines[block, 0], lines[block, 1]
        left = x - f32(LANES * block)
        for i in range(TILE):
            line, to = np.int32(first + i), np.uint64(end + i)
            dy = f32(line) - y
            rows[PLACE, to] = np.uint32(line + TILE * block)
            rows[SPLAT, to] = np.uint32(k)
            terms[MIDDLE, to] = along * (left + shear * dy)
            terms[MOST, to] = log - across * dy * dy
        end += max(0, last - first)
    return end


@kernel(inline=True)
def listed(splats, rows, terms, j):
    """Return SPLAT, MIDDLE and MOST of row j of a list, and that splat's ALONG, LEAST, RED, GREEN and BLUE."""
    k = rows[SPLAT, j]
    shape = terms[MIDDLE, j], terms[MOST, j], splats[ALONG, k], splats[LEAST, k]
    return k, *shape, splats[RED, k], splats[GREEN, k], splats[BLUE, k]


@kernel(inline=True)
def blend_rows(pixels, splats, rows, terms, first, last, design, least):
    """Blend splats into the rows `first` to `last` of a list; they are all merged ones, or all others.

    `pixels` are (BLOCKS * TILE, 4, LANES) transmittance, red, green and blue; `last` is excluded, and more than
    `first`.
    """
    if splats[OPACITY, rows[SPLAT, first]] <= 1:
        for j in range(first, last):
            k, middle, most, along, end, red, green, blue = listed(splats, rows, terms, j)
            lanes = pixels[rows[PLACE, j]]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                blend(lanes, i, plain(t), t >= end, red, green, blue)
    elif design:
        for j in range(first, last):
            k, middle, most, along, end, red, green, blue = listed(splats, rows, terms, j)
            lanes, d = pixels[rows[PLACE, j]], splats[OPACITY, k]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                alpha = shifted(t, d)
                blend(lanes, i, alpha, (t >= end) & (alpha >= least), red, green, blue)
    else:
        for j in range(first, last):
            k, middle, most, along, end, red, green, blue = listed(splats, rows, terms, j)
            lanes, power = pixels[rows[PLACE, j]], splats[POWER, k]
            for i in range(LANES):
                away = along * f32(i) - middle
                t = most - away * away
                alpha = merged(t, power)
                blend(lanes, i, alpha, (t >= end) & (alpha >= least), red, green, blue)


@kernel(inline=True)
def blend_batch(pixels, splats, count, lines, rows, terms, design, least):
    """Blend a batch of `count` splats, after `measure`, from near to far; for the arguments see `blend_rows`.

    Rows of several splats are blended in one loop: the ends of a loop for each splat would be mispredicted.
    """
    k = 0
    while k < count:
        is_merged = splats[OPACITY, k] > 1
        end = 0
        while k < count and (splats[OPACITY, k] > 1) == is_merged:
            end = list_rows(splats, k, lines[k], rows, terms, end)
            k += 1
        if end > 0:
            blend_rows(pixels, splats, rows, terms, 0, end, design, least)


@kernel(inline=True)
def measure(row, left, top, rows, columns, lines):
    """Fill (BLOCKS, 2) rows of pixels, the last excluded, that a splat may cover in each column of blocks of a tile.

    Branch-free. The ellipse of an elongated splat fills half its box or less. Its side is lowest in the column at its
    lowest point, or else at the column's nearer edge. X and Y of `row` become those from the middle of the tile's first
    pixel; `left`, `top` are pixels left of and above the tile, `rows`, `columns` those of the tile.
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


@kernel(inline_late=True, contract=True)
def draw_tile(screen, start, splats, tile, across, design, least, image):
    """Blend the splats of a tile, from near to far, see `draw_tiles`; return where in `splats` it stopped."""
    height, width = image.shape[:2]
    left, top = tile % across * TILE, tile // across * TILE
    down, right = min(TILE, height - top), min(TILE, width - left)
    pixels = np.zeros((BLOCKS * TILE, 4, LANES), np.float32)
    fetched, lines = np.empty((COLUMNS, BATCH), np.float32), np.empty((BATCH, BLOCKS, 2), np.int32)
    rows, terms = np.empty((2, ROWS), np.uint32), np.empty((2, ROWS), np.float32)
    for block in range(BLOCKS):
        for line in range(down):
            for i in range(LANES):
                pixels[TILE * block + line, 0, i] = f32(1) if LANES * block + i < right else f32(0)
    floats, stop = screen.reshape(-1), start[tile + 1]
    clear = 0  # all pixels before it are opaque, and stay so
    for entry in range(start[tile], start[tile + 1], BATCH):
        count = min(BATCH, start[tile + 1] - entry)
        for k in range(entry + BATCH, min(entry + 2 * BATCH, start[tile + 1])):
            prefetch(floats, np.int64(splats[k]) * COLUMNS)
        for k in range(count):
            found = np.uint64(splats[entry + k]) * np.uint64(COLUMNS)
            for column in range(COLUMNS):
                fetched[column, k] = floats[found + np.uint64(column)]
        for k in range(count):
            measure(fetched[:, k], left, top, down, right, lines[k])
        blend_batch(pixels, fetched, count, lines, rows, terms, design, least)
        while clear < BLOCKS * TILE * LANES and pixels[clear // LANES, 0, clear % LANES] < OPAQUE:
            clear += 1
        if clear == BLOCKS * TILE * LANES:
            stop = min(entry + BATCH, stop)
            break
    for line in range(down):
        for i in range(right):
            lanes = pixels[TILE * (i // LANES) + line]
            image[top + line, left + i, 0] = lanes[1, i % LANES]
            image[top + line, left + i, 1] = lanes[2, i % LANES]
            image[top + line, left + i, 2] = lanes[3, i % LANES]
            image[top + line, left + i, 3] = f32(1) - lanes[0, i % LANES]
    return stop


@kernel(i8, f4[:, :], i8[:], i4[:], i8, b1, f4, out(f4[:, :, :]), out(i8[:]), ranges=True, contract=True)
def draw_tiles(begin, end, screen, start, splats, across, design, least, image, stop):
    """Blend the splats of each tile, from near to far; `start` and `splats` are those of `rasterizer.sort_into_tiles`.

    Args:
        across: number of tiles in a row of them.
        design: merged splats have the falloff `shifted`, that of Spark's LoD design.
        least: least alpha that is drawn.
        image: (height, width, 4) filled: red, green and blue, premultiplied by alpha, and alpha.
        stop: (tiles,) filled: up to where in `splats` each tile was drawn; it is opaque before the rest.
    """
    for tile in range(begin, end):
        stop[tile] = draw_tile(screen, start, splats, tile, across, design, least, image)


@kernel(i8, f4[:], f4[:], f4[:], f4[:, :], f4, out(f4[:, :, :]), ranges=True)
def draw_discs(top, bottom, x, y, radius, rgb, alpha, image):
    """Blend discs in order, each over those before it, on a (height, width, 4) picture; centres and radii in pixels."""
    width = image.shape[1]
    for i in range(len(x)):
        r = radius[i]
        if y[i] + r < top or y[i] - r > bottom:
            continue
        for line in range(top, bottom):
            dy = f32(line) + f32(0.5) - y[i]
            square = r * r - dy * dy
            if square < 0:
                continue
            half = np.sqrt(square)
            first = max(0, math.ceil(x[i] - half - f32(0.5)))
            last = min(width - 1, math.floor(x[i] + half - f32(0.5)))
            for column in range(first, last + 1):
                for c in range(3):
                    image[line, column, c] += alpha * (rgb[i, c] - image[line, column, c])
                image[line, column, 3] += alpha * (f32(1) - image[line, column, 3])


@kernel(i8, f4[:, :], u8[:], b1, f4, out(i4[:, :]), ranges=True)
def count_fragments(top, bottom, screen, keys, design, least, counts):
    """Add the number of splats that cover each pixel, hidden ones included, to (height, width) counts.

    Args:
        screen, keys: of `project`; the (M,) keys are those of splats that are drawn, in any order.
        design, least: of `raster.draw_tiles`.
    """
    width = counts.shape[1]
    for key in keys:
        row = screen[index_of(key)]
        first_line = max(top, math.ceil(row[Y] - row[HALF_HEIGHT] - f32(0.5)))
        last_line = min(bottom - 1, math.floor(row[Y] + row[HALF_HEIGHT] - f32(0.5)))
        if first_line > last_line:
            continue
        first = max(0, math.ceil(row[X] - row[HALF_WIDTH] - f32(0.5)))
        last = min(width - 1, math.floor(row[X] + row[HALF_WIDTH] - f32(0.5)))
        d = row[OPACITY]
        for line in range(first_line, last_line + 1):
            dy = f32(line) + f32(0.5) - row[Y]
            for column in range(first, last + 1):
                dx = f32(column) + f32(0.5) - row[X]
                t = exponent(row, dx, dy)
                if t < row[LEAST]:
                    continue
                if alpha_at(t, d, row[POWER], design) >= least:
                    counts[line, column] += 1
