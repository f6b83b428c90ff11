"""Projects splats onto the screen, where each covers an ellipse."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...model import gaussian
from ...system.jit import b1, f4, fields, i2, i8, kernel, out, u8
from .ellipse import Lens, Limits, ellipse, on_screen, shortened

f32 = np.float32

#: Columns of a splat on the screen, float32, 64 bytes:
#: X, Y: its centre, in pixels from the upper left corner.
#: ALONG, SHEAR, ACROSS, LOG: of the exponent t of its falloff 2 ** t, dx and dy pixels from its centre:
#: t = LOG - (ALONG (dx - SHEAR dy))^2 - ACROSS dy^2. A dx^2 + 2 B dx dy + C dy^2 is the same, but its terms cancel in
#: needles. LOG is log2(D) up to D = 1, so that 2 ** t is alpha, and 0 above.
#: LEAST: the splat is drawn where t is at least this.
#: OPACITY, POWER: D, and the exponent of the falloff, linear opacity above D = 1 and 1 up to it.
#: RED, GREEN, BLUE: its colour.
#: HALF_WIDTH, HALF_HEIGHT: half the sides of its box, pixels.
#: SLOPE, TALL: y by x of the middle between the upper and the lower side of its ellipse, and half the height of the
#: ellipse above its centre, pixels.
X, Y, ALONG, SHEAR, ACROSS, LOG, LEAST, OPACITY = range(8)
POWER, RED, GREEN, BLUE, HALF_WIDTH, HALF_HEIGHT, SLOPE, TALL = range(8, 16)
COLUMNS = 16

#: Splats that are projected together: their fields, 9 KB, stay in the first-level cache. Chosen.
GROUP = 64

#: Fields of a splat while it is projected, besides its columns: its geometry, and the fields of `OnScreen`, float32.
CENTER, SCALE, QUAT = 16, 19, 22
SEEN, XX, XY, YY, DET, DEVIATIONS, LONGEST, DEPTH, SQUARE = range(26, 35)
FIELDS = 35

#: Side of a tile of the picture, pixels.
TILE = 16

#: Largest colour value, that of the float16 that Spark keeps colours in.
MAX_COLOR = f32(65504)

#: The key of a splat that is not drawn; it is sorted behind all others.
NOT_DRAWN = np.uint64(0xFFFFFFFFFFFFFFFF)

#: The distance of a splat that is not drawn.
NOT_SEEN = f32(-1)

#: The largest index in a key, whose lower half it is.
MAX_INDEX = 0xFFFFFFFF

linear_opacity_above_1 = kernel(inline=True)(gaussian.linear_opacity_above_1)


@fields(f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :])
class ShadedColumns(NamedTuple):
    """Columns of `ShadedSplats`, float32."""

    center: Any  # (N, 3)
    scale: Any  # (N, 3)
    quat_xyzw: Any  # (N, 4)
    lod_opacity: Any  # (N,)
    rgb: Any  # (N, 3)


@kernel(inline=True)
def power_of(d):
    """Return POWER of a splat of D."""
    return linear_opacity_above_1(d, f32(1), f32(np.e)) if d > 1 else f32(1)


@kernel(inline=True)
def shown_color(value):
    """Return a colour value as it is drawn; NaN is 0."""
    return min(value, MAX_COLOR) if value > 0 else f32(0)


@kernel(inline=True)
def is_in_picture(x, y, half_width, half_height, lens):
    """Return whether a box overlaps the picture, or has a side that is not a number."""
    return not (
        (x + half_width < 0) | (x - half_width > lens.width) | (y + half_height < 0) | (y - half_height > lens.height)
    )


@kernel(inline_late=True)
def project_splat(splats, i, world_to_camera, lens, limits, radial, row):
    """Project splat `i` onto the screen, as Spark's vertex shader does, into a row of (COLUMNS,) if it is drawn.

    Returns:
        distance to sort by, world units: from the camera if `radial`, or else depth; NOT_SEEN if the splat is not
            drawn.
    """
    center, scale, quat, rgb = splats.center[i], splats.scale[i], splats.quat_xyzw[i], splats.rgb[i]
    place, size = (center[0], center[1], center[2]), (scale[0], scale[1], scale[2])
    turn = quat[0], quat[1], quat[2], quat[3]
    s = on_screen(place, size, turn, splats.lod_opacity[i], world_to_camera, lens, limits)
    a, b, c, det = s.a, s.b, s.c, s.det
    if not s.is_seen:
        return NOT_SEEN
    if s.longest > limits.max_radius:
        a, b, c, det = shortened(a, b, c, det, s.deviations, limits.max_radius)
        if not det > 0:
            return NOT_SEEN
    along, shear, across, log, least, half_width, half_height, slope, tall = ellipse(
        a, b, c, det, s.d, s.deviations, limits.min_alpha
    )
    row[X], row[Y], row[ALONG], row[SHEAR], row[ACROSS], row[LOG] = s.x, s.y, along, shear, across, log
    row[LEAST], row[OPACITY], row[POWER] = least, s.d, power_of(s.d)
    row[RED], row[GREEN], row[BLUE] = shown_color(rgb[0]), shown_color(rgb[1]), shown_color(rgb[2])
    row[HALF_WIDTH], row[HALF_HEIGHT], row[SLOPE], row[TALL] = half_width, half_height, slope, tall
    if not is_in_picture(s.x, s.y, half_width, half_height, lens):
        return NOT_SEEN
    return np.sqrt(s.square) if radial else s.depth


@kernel(inline=True)
def exponent(row, dx, dy):
    """Return t of the falloff 2 ** t of a splat on the screen, from its centre to a pixel; see `COLUMNS`."""
    along = row[ALONG] * (dx - row[SHEAR] * dy)
    return row[LOG] - along * along - row[ACROSS] * dy * dy


@kernel(inline=True)
def tiles_of(row, across, down):
    """Return first and last tile on each axis that overlap the box of a splat on the screen."""
    left = max(0, math.floor((row[X] - row[HALF_WIDTH]) / TILE))
    right = min(across - 1, math.floor((row[X] + row[HALF_WIDTH]) / TILE))
    top = max(0, math.floor((row[Y] - row[HALF_HEIGHT]) / TILE))
    bottom = min(down - 1, math.floor((row[Y] + row[HALF_HEIGHT]) / TILE))
    return left, right, top, bottom


@kernel(inline=True)
def index_of(key):
    """Return which splat a key is of."""
    return MAX_INDEX - np.int64(key & np.uint64(MAX_INDEX))


@kernel(i8, ShadedColumns, f4[:, :], Lens, Limits, b1, out(f4[:, :]), out(u8[:]), out(i2[:, :]), ranges=True)
def project(start, stop, splats, world_to_camera, lens, limits, radial, screen, keys, boxes):
    """Project splats onto the screen: the same as `project_splat`, but for many splats at once.

    Args:
        screen: (N, COLUMNS) filled for splats that are drawn.
        keys: (N,) filled with distance and index, so that they sort from near to far, and among equal distances the
            last splat is in front, as in Spark; NOT_DRAWN for splats that are not drawn.
        boxes: (N, 4) filled with the `tiles_of` splats that are drawn, and for others with an empty box.
    """
    fields = np.empty((FIELDS, GROUP), np.float32)
    for first in range(start, stop, GROUP):
        count = min(GROUP, stop - first)
        project_group(splats, first, count, world_to_camera, lens, limits, fields)
        finish_group(splats, first, count, lens, radial, fields, screen, keys, boxes)


@kernel(inline=True)
def project_group(splats, start, count, world_to_camera, lens, limits, fields):
    """Fill the fields of `count` splats from `start` on, but POWER and colours.

    Its loops are branch-free and over one field each, so that LLVM vectorizes them.
    """
    for k in range(count):
        i = start + k
        for axis in range(3):
            fields[CENTER + axis, k] = splats.center[i, axis]
            fields[SCALE + axis, k] = splats.scale[i, axis]
        for axis in range(4):
            fields[QUAT + axis, k] = splats.quat_xyzw[i, axis]
        fields[OPACITY, k] = splats.lod_opacity[i]
    for k in range(count):
        center = fields[CENTER, k], fields[CENTER + 1, k], fields[CENTER + 2, k]
        scale = fields[SCALE, k], fields[SCALE + 1, k], fields[SCALE + 2, k]
        quat = fields[QUAT, k], fields[QUAT + 1, k], fields[QUAT + 2, k], fields[QUAT + 3, k]
        s = on_screen(center, scale, quat, fields[OPACITY, k], world_to_camera, lens, limits)
        fields[SEEN, k], fields[X, k], fields[Y, k] = f32(1) if s.is_seen else f32(0), s.x, s.y
        fields[XX, k], fields[XY, k], fields[YY, k], fields[DET, k] = s.a, s.b, s.c, s.det
        fields[OPACITY, k], fields[DEVIATIONS, k], fields[LONGEST, k] = s.d, s.deviations, s.longest
        fields[DEPTH, k], fields[SQUARE, k] = s.depth, s.square
    for k in range(count):
        if fields[SEEN, k] > 0 and fields[LONGEST, k] > limits.max_radius:
            a, b, c, det = fields[XX, k], fields[XY, k], fields[YY, k], fields[DET, k]
            a, b, c, det = shortened(a, b, c, det, fields[DEVIATIONS, k], limits.max_radius)
            fields[XX, k], fields[XY, k], fields[YY, k], fields[DET, k] = a, b, c, det
    for k in range(count):
        a, b, c, det = fields[XX, k], fields[XY, k], fields[YY, k], fields[DET, k]
        along, shear, across, log, least, half_width, half_height, slope, tall = ellipse(
            a, b, c, det, fields[OPACITY, k], fields[DEVIATIONS, k], limits.min_alpha
        )
        is_inside = is_in_picture(fields[X, k], fields[Y, k], half_width, half_height, lens)
        fields[SEEN, k] = f32(1) if (fields[SEEN, k] > 0) & (det > 0) & is_inside else f32(0)
        fields[ALONG, k], fields[SHEAR, k], fields[ACROSS, k] = along, shear, across
        fields[LOG, k], fields[LEAST, k] = log, least
        fields[HALF_WIDTH, k], fields[HALF_HEIGHT, k] = half_width, half_height
        fields[SLOPE, k], fields[TALL, k] = slope, tall


@kernel(inline_late=True)
def finish_group(splats, start, count, lens, radial, fields, screen, keys, boxes):
    """Fill `screen`, `keys` and `boxes` of `project` of the fields of `count` splats from `start` on."""
    across, down = -(-np.int64(lens.width) // TILE), -(-np.int64(lens.height) // TILE)
    for k in range(count):
        i = start + k
        if fields[SEEN, k] > 0:
            fields[POWER, k] = power_of(fields[OPACITY, k])
            for channel in range(3):
                fields[RED + channel, k] = shown_color(splats.rgb[i, channel])
            row = screen[i]
            for column in range(COLUMNS):
                row[column] = fields[column, k]
            depth = np.sqrt(fields[SQUARE, k]) if radial else fields[DEPTH, k]
            keys[i] = (np.uint64(np.float32(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(MAX_INDEX - i)
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = tiles_of(row, across, down)
        else:
            keys[i] = NOT_DRAWN
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, -1, 0, -1
