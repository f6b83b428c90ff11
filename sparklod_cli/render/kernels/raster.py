"""Sorts splats into tiles and draws the tiles."""

from __future__ import annotations

import math

import numpy as np

from ...support.jit import kernel, prange
from .falloff import merged, plain, shifted
from .project import BLUE, END, GREEN, HALF_HEIGHT, HALF_WIDTH, OPACITY, POWER, RED, A, B, C, X, Y

f32 = np.float32

#: Side of a tile, pixels, and pixels of a row that are blended at once: the float32 of one AVX2 vector.
TILE, LANES = 16, 8

#: A tile is finished when no pixel has a transmittance of this or more, 1/40 of an 8-bit step. Chosen.
OPAQUE = f32(1e-4)

#: Bound of what rounding changes z^2 by, as a share of A times the squared half width of the box. Chosen: some twenty
#: roundings of float32.
ROUNDING = f32(2.5e-7)

#: Number of splats between two checks for OPAQUE. Chosen.
CHECK_EVERY = 16


@kernel(inline=True)
def tiles_of(row, across, down):
    """First and last tile on each axis that overlap the box of a splat."""
    left = max(0, math.floor((row[X] - row[HALF_WIDTH]) / TILE))
    right = min(across - 1, math.floor((row[X] + row[HALF_WIDTH]) / TILE))
    top = max(0, math.floor((row[Y] - row[HALF_HEIGHT]) / TILE))
    bottom = min(down - 1, math.floor((row[Y] + row[HALF_HEIGHT]) / TILE))
    return left, right, top, bottom


@kernel(parallel=True)
def sort_into_tiles(screen, across, down, blocks):
    """Lists the splats of each tile, in their order.

    Args:
        screen: (N, COLUMNS) of `project`, from near to far.
        across, down: numbers of tiles.
        blocks: ranges of splats to process in parallel; the result does not depend on it.

    Returns:
        start: (tiles + 1,) int64, where the splats of each tile begin.
        splats: (total,) int32 rows of `screen`.
    """
    tiles = across * down
    count = np.zeros((blocks, tiles), np.int32)
    n = len(screen)
    for block in prange(blocks):
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            left, right, top, bottom = tiles_of(screen[i], across, down)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
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
        for i in range(n * block // blocks, n * (block + 1) // blocks):
            left, right, top, bottom = tiles_of(screen[i], across, down)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    tile = y * across + x
                    splats[at[block, tile]] = i
                    at[block, tile] += 1
    return start, splats


@kernel(inline=True)
def blend(pixels, i, alpha, inside, least, red, green, blue):
    """Blends a splat behind what a pixel has so far; branch-free, so that LLVM vectorizes over the pixels of a row.

    Colours are clamped to 1 after they are multiplied by alpha, as in an 8-bit picture.
    """
    alpha = alpha if inside & (alpha >= least) else f32(0)
    through = pixels[0, i]
    pixels[1, i] += through * min(alpha * red, f32(1))
    pixels[2, i] += through * min(alpha * green, f32(1))
    pixels[3, i] += through * min(alpha * blue, f32(1))
    pixels[0, i] = through - through * alpha


@kernel(inline=True)
def blend_lanes(pixels, row, x, dy, design, least):
    """Blends a splat into adjacent pixels of a row.

    Args:
        pixels: (4, LANES) float32: transmittance, red, green and blue.
        row: the splat, a row of `screen`.
        x: its centre from the middle of the first pixel, pixels.
        dy: from its centre to the row of pixels, pixels.
        design: merged splats have the falloff `shifted`, that of Spark's LoD design.
        least: float32, least alpha that is drawn.
    """
    a, b, c, edge, d, power = row[A], f32(2) * row[B] * dy, row[C] * dy * dy, row[END], row[OPACITY], row[POWER]
    red, green, blue = row[RED], row[GREEN], row[BLUE]
    if d <= 1:
        for i in range(LANES):
            dx = f32(i) - x
            z2 = (a * dx + b) * dx + c
            blend(pixels, i, plain(z2, d), z2 <= edge, least, red, green, blue)
    elif design:
        for i in range(LANES):
            dx = f32(i) - x
            z2 = (a * dx + b) * dx + c
            blend(pixels, i, shifted(z2, d), z2 <= edge, least, red, green, blue)
    else:
        for i in range(LANES):
            dx = f32(i) - x
            z2 = (a * dx + b) * dx + c
            blend(pixels, i, merged(z2, power), z2 <= edge, least, red, green, blue)


@kernel(inline=True)
def is_opaque(pixels, rows, columns):
    """Whether no pixel of a tile has a transmittance of OPAQUE or more."""
    most = f32(0)
    for line in range(rows):
        for i in range(columns):
            most = max(most, pixels[line, i // LANES, 0, i % LANES])
    return most < OPAQUE


@kernel(inline=True)
def box_in_tile(row, left, top, rows, columns):
    """The part of a tile that the box of a splat covers.

    Args:
        row: the splat, a row of `screen`.
        left, top: pixels left of and above the tile.
        rows, columns: of the tile's pixels.

    Returns:
        x, y: the splat's centre from the middle of the tile's first pixel, pixels, float32.
        first, last: rows of pixels, the last excluded.
        begin, end: columns of blocks of LANES pixels, the last excluded.
    """
    x, y = row[X] - f32(left) - f32(0.5), row[Y] - f32(top) - f32(0.5)
    first = max(0, math.ceil(y - row[HALF_HEIGHT]))
    last = min(rows, math.floor(y + row[HALF_HEIGHT]) + 1)
    begin = max(0, math.ceil(x - row[HALF_WIDTH])) // LANES
    end = (min(columns, math.floor(x + row[HALF_WIDTH]) + 1) + LANES - 1) // LANES
    return x, y, first, last, begin, end


@kernel(inline=True)
def tilt_of(row):
    """The shape of a splat's ellipse, for `lines_of`; float32, pixels.

    Returns:
        lean: x of the ellipse's lowest point.
        slope: y by x of the middle between its upper and lower side.
        tall: half its height at x = 0.
        narrow: 1 / half its width squared.
        slack: 1 and what rounding may add to z^2 / END.
    """
    a, b, c, wide2 = row[A], row[B], row[C], row[HALF_WIDTH] * row[HALF_WIDTH]
    inverse = f32(1) / (a * c)
    return (
        -b * c * inverse * row[HALF_HEIGHT],
        -b * a * inverse,
        np.sqrt(row[END] * a * inverse),
        f32(1) / wide2,
        f32(1.01) + ROUNDING * a * wide2,
    )


@kernel(inline=True)
def lines_of(x, y, lean, slope, tall, narrow, slack, first, last):
    """Rows of pixels in which a splat may be drawn in a column of blocks: first, and last excluded.

    The ellipse of an elongated splat fills half its box or less. Its side is lowest in the column at its lowest point,
    or else at the column's nearer edge.

    Args:
        x, y: the splat's centre from the middle of the column's first pixel, pixels.
        lean, slope, tall, narrow, slack: of `tilt_of`.
        first, last: rows of the splat's box.
    """
    left, right = -x, f32(LANES - 1) - x
    low, high = min(max(lean, left), right), min(max(-lean, left), right)
    below = y + slope * low + tall * np.sqrt(max(slack - low * low * narrow, f32(0)))
    above = y + slope * high - tall * np.sqrt(max(slack - high * high * narrow, f32(0)))
    return max(first, np.int64(above)), min(last, np.int64(below) + 2)


@kernel(inline=True)
def draw_tile(screen, start, splats, tile, across, design, least, image):
    """Blends the splats of a tile, from near to far, see `draw_tiles`; returns where in `splats` it stopped."""
    height, width = image.shape[:2]
    left, top = tile % across * TILE, tile // across * TILE
    pixels = np.zeros((TILE, TILE // LANES, 4, LANES), np.float32)
    pixels[:, :, 0] = 1
    rows = min(TILE, height - top)
    columns = min(TILE, width - left)
    stop = start[tile + 1]
    for entry in range(start[tile], start[tile + 1]):
        row = screen[splats[entry]]
        x, y, first, last, begin, end = box_in_tile(row, left, top, rows, columns)
        lean, slope, tall, narrow, slack = tilt_of(row)
        for block in range(begin, end):
            away = x - f32(LANES * block)
            top_line, bottom_line = lines_of(away, y, lean, slope, tall, narrow, slack, first, last)
            for line in range(top_line, bottom_line):
                blend_lanes(pixels[line, block], row, away, f32(line) - y, design, least)
        if (entry - start[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(pixels, rows, columns):
            stop = entry + 1
            break
    for line in range(rows):
        for i in range(columns):
            lanes = pixels[line, i // LANES]
            image[top + line, left + i, 0] = lanes[1, i % LANES]
            image[top + line, left + i, 1] = lanes[2, i % LANES]
            image[top + line, left + i, 2] = lanes[3, i % LANES]
            image[top + line, left + i, 3] = f32(1) - lanes[0, i % LANES]
    return stop


@kernel(parallel=True, contract=True)
def draw_tiles(screen, start, splats, across, design, least, image, stop):
    """Blends the splats of each tile, from near to far.

    Args:
        screen, start, splats: of `sort_into_tiles`.
        across: number of tiles in a row of them.
        design: merged splats have the falloff `shifted`, that of Spark's LoD design.
        least: float32, least alpha that is drawn.
        image: (height, width, 4) float32, filled: red, green and blue, premultiplied by alpha, and alpha.
        stop: (tiles,) int64, filled: up to where in `splats` each tile was drawn; it is opaque before the rest.
    """
    for tile in prange(len(stop)):
        stop[tile] = draw_tile(screen, start, splats, tile, across, design, least, image)
