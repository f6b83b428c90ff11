"""The way back through the tiles: what a loss changes by with each splat on the screen.

The loss is any function of a picture; its derivatives by the picture's values are given. A tile passes its splats from
near to far, as the forward pass does, and for each it writes a row of sums over the tile's pixels, so that no two tiles
write to the same place and the order of all sums is that of the splats and tiles, whatever the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, fields, i2, i4, i8, out
from .falloff import merged_parts, plain
from .project import ACROSS, ALONG, BLUE, COLUMNS, GREEN, LEAST, LOG, OPACITY, POWER, RED, SHEAR, TILE, X, Y
from .raster import BLOCKS, LANES, measure

f32 = np.float32

#: Columns of a row of sums over pixels, float32: derivatives by z^2, times v, dy, v^2, v dy and dy^2, where v is the
#: distance along a row of `project.exponent`; by D, of merged splats by the power; by red, green and blue.
BY_X, BY_Y, BY_XX, BY_XY, BY_YY, BY_SHAPE, BY_RED, BY_GREEN, BY_BLUE = range(9)
SUMS = 9

#: What is kept of LANES adjacent pixels, after the sums of one splat over the rows of pixels above: transmittance; what
#: is yet to be drawn, as the loss weighs it; the derivatives of the loss by red, green and blue.
THROUGH, REST, OF_RED, OF_GREEN, OF_BLUE = range(SUMS, SUMS + 5)
FIELDS = SUMS + 5

#: Floats of a record of LANES pixels. The records of pixels that lie one below the other are consecutive, so that each
#: writes its sums to the beginning of the next: at a constant distance, which LLVM vectorizes, as it need not look
#: whether they overlap.
RECORD = FIELDS * LANES

#: Least 1 - alpha that is divided by. Chosen: where less passes, tiles end (`raster.OPAQUE`), and float32 holds what
#: is behind to 1e-3.
LEAST_THROUGH = f32(1e-4)

LN2 = f32(np.log(2))


@fields(f4[:, :], i2[:, :], i8[:], i4[:], i8[:], i8)
class Drawn(NamedTuple):
    """A picture's splats and tiles.

    Attributes:
        screen, boxes: (N, COLUMNS) float32 and (N, 4) int16 of `project`.
        start, splats, stop: of `draw_tiles`.
        across: number of tiles in a row of them.
    """

    screen: Any
    boxes: Any
    start: Any
    splats: Any
    stop: Any
    across: Any


@kernel(i2[:, :])
def first_rows(boxes):
    """(N + 1,) int64 where the rows of each splat begin, one for each tile that its box overlaps."""
    first = np.empty(len(boxes) + 1, np.int64)
    total = 0
    for i in range(len(boxes)):
        first[i] = total
        total += max(0, boxes[i, 1] - boxes[i, 0] + 1) * max(0, boxes[i, 3] - boxes[i, 2] + 1)
    first[len(boxes)] = total
    return first


@kernel(inline=True)
def weigh(record, i, alpha, by_z2, by_shape, is_drawn, red, green, blue, v, dy):
    """Moves one pixel behind a splat, and writes the terms of the splat's sums; branch-free, as `raster.blend`.

    Args:
        record: (RECORD + SUMS * LANES,) float32 of the pixels and the beginning of the next.
        i: which lane.
        alpha: of the splat.
        by_z2, by_shape: derivatives of alpha.
        is_drawn: the splat is drawn at the pixel.
        red, green, blue: of the splat.
        v, dy: from its centre to the pixel; see `SUMS`.
    """
    alpha = alpha if is_drawn else f32(0)
    through = record[THROUGH * LANES + i]
    r, g, b = alpha * red, alpha * green, alpha * blue
    # A colour that is clamped to 1 depends on nothing.
    of_red = record[OF_RED * LANES + i] if r < f32(1) else f32(0)
    of_green = record[OF_GREEN * LANES + i] if g < f32(1) else f32(0)
    of_blue = record[OF_BLUE * LANES + i] if b < f32(1) else f32(0)
    shown = (
        record[OF_RED * LANES + i] * min(r, f32(1))
        + record[OF_GREEN * LANES + i] * min(g, f32(1))
        + record[OF_BLUE * LANES + i] * min(b, f32(1))
    )
    rest = record[REST * LANES + i] - through * shown
    by_alpha = through * (of_red * red + of_green * green + of_blue * blue) - rest / max(f32(1) - alpha, LEAST_THROUGH)
    record[REST * LANES + i] = rest
    record[THROUGH * LANES + i] = through - through * alpha
    # Where a splat is not drawn, derivatives of alpha may be anything.
    along = by_alpha * by_z2 if is_drawn else f32(0)
    along_x, along_y = along * v, along * dy
    record[(FIELDS + BY_X) * LANES + i] = record[BY_X * LANES + i] + along_x
    record[(FIELDS + BY_Y) * LANES + i] = record[BY_Y * LANES + i] + along_y
    record[(FIELDS + BY_XX) * LANES + i] = record[BY_XX * LANES + i] + along_x * v
    record[(FIELDS + BY_XY) * LANES + i] = record[BY_XY * LANES + i] + along_x * dy
    record[(FIELDS + BY_YY) * LANES + i] = record[BY_YY * LANES + i] + along_y * dy
    record[(FIELDS + BY_SHAPE) * LANES + i] = record[BY_SHAPE * LANES + i] + (
        by_alpha * by_shape if is_drawn else f32(0)
    )
    seen = through * alpha
    record[(FIELDS + BY_RED) * LANES + i] = record[BY_RED * LANES + i] + seen * of_red
    record[(FIELDS + BY_GREEN) * LANES + i] = record[BY_GREEN * LANES + i] + seen * of_green
    record[(FIELDS + BY_BLUE) * LANES + i] = record[BY_BLUE * LANES + i] + seen * of_blue


@kernel(inline=True)
def weigh_lanes(record, row, x, dy, least):
    """Moves adjacent pixels of a row behind a splat; see `weigh` and `raster.blend_column`."""
    along, d, power, end = row[ALONG], row[OPACITY], row[POWER], row[LEAST]
    red, green, blue = row[RED], row[GREEN], row[BLUE]
    middle, most = along * (x + row[SHEAR] * dy), row[LOG] - row[ACROSS] * dy * dy
    if d <= 1:
        inverse = f32(1) / d
        for i in range(LANES):
            v = along * f32(i) - middle
            t = most - v * v
            alpha = plain(t)
            weigh(record, i, alpha, f32(-0.5) * alpha, alpha * inverse, t >= end, red, green, blue, v, dy)
    else:
        for i in range(LANES):
            v = along * f32(i) - middle
            t = most - v * v
            fall, rest, log, through = merged_parts(t, power)
            alpha = f32(1) - through
            is_drawn = (t >= end) & (alpha >= least)
            by_z2 = f32(-0.5) * fall * power * (through / rest)
            weigh(record, i, alpha, by_z2, -LN2 * through * log, is_drawn, red, green, blue, v, dy)


@kernel(inline=True)
def start_pixels(records, left, top, rows, columns, image, by_image):
    """Fills what is kept of a tile's pixels before the first splat."""
    records[:] = 0
    for line in range(rows):
        for i in range(columns):
            kept = records[i // LANES, line * RECORD + i % LANES :]
            seen, by = image[top + line, left + i], by_image[top + line, left + i]
            kept[THROUGH * LANES] = f32(1)
            kept[REST * LANES] = by[0] * seen[0] + by[1] * seen[1] + by[2] * seen[2] - by[3] * (f32(1) - seen[3])
            kept[OF_RED * LANES], kept[OF_GREEN * LANES], kept[OF_BLUE * LANES] = by[0], by[1], by[2]


@kernel(inline=True)
def add_lanes(lanes, out):
    """Adds (SUMS * LANES,) sums of lanes to (SUMS,) sums."""
    for k in range(SUMS):
        v = lanes[k * LANES : (k + 1) * LANES]
        out[k] += ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7]))


@kernel(Drawn, i8[:], f4, f4[:, :, :], f4[:, :, :], out(f4[:, :]), parallel=True, contract=True)
def weigh_tiles(drawn, first, least, image, by_image, sums):
    """Sums of each splat over the pixels of each tile that its box overlaps.

    Args:
        drawn: `Drawn`.
        first: of `first_rows`.
        least: float32, least alpha that is drawn.
        image: (height, width, 4) float32 of `draw_tiles`.
        by_image: (height, width, 4) float32 derivatives of the loss by it.
        sums: (first[-1], SUMS) float32, filled; 0 for splats that a tile is opaque before.
    """
    height, width = image.shape[:2]
    across = drawn.across
    for tile in prange(len(drawn.stop)):
        left, top = tile % across * TILE, tile // across * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        records = np.empty((BLOCKS, (TILE + 1) * RECORD), np.float32)
        row, lines = np.empty(COLUMNS, np.float32), np.empty((BLOCKS, 2), np.int32)
        start_pixels(records, left, top, rows, columns, image, by_image)
        for entry in range(drawn.start[tile], drawn.start[tile + 1]):
            i = drawn.splats[entry]
            box = drawn.boxes[i]
            out = sums[first[i] + (tile // across - box[2]) * (box[1] - box[0] + 1) + tile % across - box[0]]
            out[:] = 0
            if entry >= drawn.stop[tile]:
                continue
            row[:] = drawn.screen[i]
            measure(row, left, top, rows, columns, lines)
            for block in range(BLOCKS):
                top_line, bottom_line = np.int64(lines[block, 0]), np.int64(lines[block, 1])
                if top_line >= bottom_line:
                    continue
                column = records[block]
                column[top_line * RECORD : top_line * RECORD + SUMS * LANES] = 0
                for line in range(top_line, bottom_line):
                    record = column[line * RECORD : (line + 1) * RECORD + SUMS * LANES]
                    weigh_lanes(record, row, row[X] - f32(LANES * block), f32(line) - row[Y], least)
                add_lanes(column[bottom_line * RECORD : bottom_line * RECORD + SUMS * LANES], out)
