"""The backward pass of the rasterizer: derivatives of a loss by splats on the screen, and in the world.

The loss is any function of a picture; its derivatives by the picture's values are given. A tile passes its splats from
near to far, as the forward pass does, and for each it writes a row of sums over the tile's pixels, so that no two tiles
write to the same place and the order of all sums is that of the splats and tiles, whatever the number of threads.

The way through the projection is in float64, because elements of a long splat's covariance are small differences of
large numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...model.falloff import HALF_LOG2E, deviations_of, merged_slopes, plain_slopes
from ...system.jit import f4, fields, i2, i4, i8, kernel, out
from .ellipse import MAX_D, Lens, Limits, in_camera, jacobian, per_world_unit, rotation_matrix, turned
from .project import (
    ACROSS,
    ALONG,
    BLUE,
    COLUMNS,
    GREEN,
    LEAST,
    LOG,
    MAX_COLOR,
    OPACITY,
    POWER,
    RED,
    SHEAR,
    TILE,
    ShadedColumns,
    X,
    Y,
)
from .raster import BLOCKS, LANES, measure

f32, f64 = np.float32, np.float64

#: Columns of a row of sums over pixels, float32: derivatives by z^2, times v, dy, v^2, v dy and dy^2, where v is the
#: distance along a row of `project.exponent`; by D, of merged splats by the power; by red, green and blue.
BY_X, BY_Y, BY_XX, BY_XY, BY_YY, BY_SHAPE, BY_RED, BY_GREEN, BY_BLUE = range(9)
SUMS = 9

#: State of LANES adjacent pixels, after the sums of one splat over the rows of pixels above: transmittance; the rest of
#: the picture behind, weighed by the loss; the derivatives of the loss by red, green and blue.
THROUGH, REST, OF_RED, OF_GREEN, OF_BLUE = range(SUMS, SUMS + 5)
FIELDS = SUMS + 5

#: Floats of a record of LANES pixels. The records of pixels that lie one below the other are consecutive, so that each
#: writes its sums to the beginning of the next: at a constant distance, which LLVM vectorizes, as it need not look
#: whether they overlap.
RECORD = FIELDS * LANES

#: Least 1 - alpha that is divided by. Chosen: where less passes, tiles end (`raster.OPAQUE`), and float32 holds what
#: is behind to 1e-3.
LEAST_THROUGH = f32(1e-4)

#: Columns of a splat's gradient, float32, three of each but D: by centre, ln(scale), rotation vector, D and colour.
CENTER, LOG_SCALE, TURN, LOD_OPACITY, RGB = 0, 3, 6, 9, 10
GRADIENT_COLUMNS = 13


@fields(f4[:, :], i2[:, :], i8[:], i4[:], i8[:], i8)
class Drawn(NamedTuple):
    """A picture's splats and tiles."""

    screen: Any  # (N, COLUMNS) float32 of `project`
    boxes: Any  # (N, 4) int16 of it
    start: Any  # these three of `draw_tiles`
    splats: Any
    stop: Any
    across: Any  # number of tiles in a row of them


@kernel(i2[:, :], out(i8[:]))
def fill_first_rows(boxes, first):
    """Fill (N + 1,) places where the rows of each splat begin, one for each tile that its box overlaps."""
    total = 0
    for i in range(len(boxes)):
        first[i] = total
        total += max(0, boxes[i, 1] - boxes[i, 0] + 1) * max(0, boxes[i, 3] - boxes[i, 2] + 1)
    first[len(boxes)] = total


@kernel(inline=True)
def weigh(record, i, alpha, by_z2, by_shape, is_drawn, red, green, blue, v, dy):
    """Move one pixel behind a splat, and write the terms of the splat's sums; branch-free, as `raster.blend`.

    `record` has (RECORD + SUMS * LANES,) values of the pixels and the beginning of the next; `i` is the lane; `v` and
    `dy` lead from the splat's centre to the pixel, see `SUMS`; derivatives `by_z2` and `by_shape` are of alpha.
    """
    alpha = alpha if is_drawn else f32(0)
    through = record[THROUGH * LANES + i]
    r, g, b = alpha * red, alpha * green, alpha * blue
    # The derivative of a colour that is clamped to 1 is 0.
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
    """Move adjacent pixels of a row behind a splat; see `weigh` and `raster.blend_column`."""
    along, d, power, end = row[ALONG], row[OPACITY], row[POWER], row[LEAST]
    red, green, blue = row[RED], row[GREEN], row[BLUE]
    middle, most = along * (x + row[SHEAR] * dy), row[LOG] - row[ACROSS] * dy * dy
    if d <= 1:
        inverse = f32(1) / d
        for i in range(LANES):
            v = along * f32(i) - middle
            t = most - v * v
            alpha, by_z2, by_d = plain_slopes(t, inverse)
            weigh(record, i, alpha, by_z2, by_d, t >= end, red, green, blue, v, dy)
    else:
        for i in range(LANES):
            v = along * f32(i) - middle
            t = most - v * v
            alpha, by_z2, by_power = merged_slopes(t, power)
            weigh(record, i, alpha, by_z2, by_power, (t >= end) & (alpha >= least), red, green, blue, v, dy)


@kernel(inline_late=True)
def start_pixels(records, left, top, rows, columns, image, by_image):
    """Fill the state of a tile's pixels before the first splat."""
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
    """Add (SUMS * LANES,) sums of lanes to (SUMS,) sums."""
    for k in range(SUMS):
        v = lanes[k * LANES : (k + 1) * LANES]
        out[k] += ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7]))


@kernel(i8, Drawn, i8[:], f4, f4[:, :, :], f4[:, :, :], out(f4[:, :]), ranges=True, contract=True)
def weigh_tiles(begin, end, drawn, first, least, image, by_image, sums):
    """Sum for each splat over the pixels of each tile that its box overlaps.

    Args:
        first: of `fill_first_rows`.
        least: least alpha that is drawn.
        image: (height, width, 4) of `draw_tiles`.
        by_image: (height, width, 4) derivatives of the loss by it.
        sums: (first[-1], SUMS) filled; 0 for splats that a tile is opaque before.
    """
    height, width = image.shape[:2]
    across = drawn.across
    for tile in range(begin, end):
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
            for k in range(COLUMNS):
                row[k] = drawn.screen[i, k]
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


# From the screen to the world


@fields(f4[:, :], i8[:], f4[:, :])
class Rows(NamedTuple):
    """Splats on the screen, and their sums, tile by tile."""

    screen: Any  # (N, COLUMNS) float32 of `project`
    first: Any  # (N + 1,) int64 of `fill_first_rows`
    sums: Any  # (first[-1], SUMS) float32 of `weigh_tiles`


@kernel(inline=True)
def cross(a, b):
    """Return the cross product of two triples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inline=True)
def dot(a, b):
    """Return the dot product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline=True)
def weighed(a, u, b, v, c, w):
    """Return a u + b v + c w of triples u, v and w."""
    return a * u[0] + b * v[0] + c * w[0], a * u[1] + b * v[1] + c * w[1], a * u[2] + b * v[2] + c * w[2]


@kernel(i8, ShadedColumns, f4[:, :], Lens, Limits, Rows, out(f4[:, :]), ranges=True)
def carry_back(start, stop, splats, world_to_camera, lens, limits, rows, gradients):
    """Compute the derivatives by the properties of splats that are drawn, (N, GRADIENT_COLUMNS); see `SplatGradients`.

    The box of a splat and where it ends are held constant, and so is the shape of one whose axes are shortened to the
    largest radius.
    """
    for i in range(start, stop):
        if rows.first[i] == rows.first[i + 1]:
            continue
        total = np.zeros(SUMS)
        for entry in range(rows.first[i], rows.first[i + 1]):
            for column in range(SUMS):
                total[column] += rows.sums[entry, column]
        carry_splat_back(splats, i, world_to_camera, lens, limits, rows.screen[i], total, gradients[i])


@kernel(inline_late=True)
def carry_splat_back(splats, i, m, lens, limits, seen, total, row):
    """Fill a row of gradients from splat `i` on the screen and its sums; see `carry_back`."""
    one, two, half = f64(1), f64(2), f64(0.5)
    center, scale, quat = splats.center, splats.scale, splats.quat_xyzw
    for channel in range(3):
        is_held = splats.rgb[i, channel] > MAX_COLOR
        row[RGB + channel] = f64(0) if is_held else total[BY_RED + channel]
    # The projection again, with its names.
    u, v, w = in_camera(m, f64(center[i, 0]), f64(center[i, 1]), f64(center[i, 2]))
    inverse = one / w
    dx, dy = lens.focal_x * u * inverse, lens.focal_y * v * inverse
    jx, jy, kx, ky = jacobian(lens, inverse, dx, dy)
    across, down = per_world_unit(m, 0, jx, kx), per_world_unit(m, 1, jy, ky)
    rotation = rotation_matrix(f64(quat[i, 0]), f64(quat[i, 1]), f64(quat[i, 2]), f64(quat[i, 3]), one)
    s = (f64(scale[i, 0]), f64(scale[i, 1]), f64(scale[i, 2]))
    p_unit, q_unit = turned(across, rotation), turned(down, rotation)
    p = (p_unit[0] * s[0], p_unit[1] * s[1], p_unit[2] * s[2])
    q = (q_unit[0] * s[0], q_unit[1] * s[1], q_unit[2] * s[2])
    a, c = dot(p, p), dot(q, q)
    normal = cross(p, q)
    before = dot(normal, normal)
    det = before + limits.blur * (a + c) + limits.blur * limits.blur
    a += limits.blur
    c += limits.blur
    # D: compensated for the blur by sqrt(before / det), and the exponent of a merged splat.
    kept, d = math.sqrt(before / det), f64(seen[OPACITY])
    by_d = total[BY_SHAPE]
    if d > one:
        by_d *= math.exp((d * d - one) / math.e) * two * d / math.e
    row[LOD_OPACITY] = by_d * kept if splats.lod_opacity[i] <= MAX_D else f64(0)
    by_before = half * by_d * d * (one / before - one / det)
    by_blurred = -half * by_d * d / det * limits.blur  # by a and by c through det
    # The shape: z^2 = (dx - (b / c) dy)^2 c / det + dy^2 / c, so that v^2 is the first term times HALF_LOG2E.
    along, shear = f64(seen[ALONG]), f64(seen[SHEAR])
    mean = half * (a + c)
    lod_opacity = f64(min(splats.lod_opacity[i], MAX_D))
    deviations = deviations_of(lod_opacity, limits.std_devs, limits.std_devs_per_d)
    longest = deviations * math.sqrt(mean + math.sqrt(max(mean * mean - det, f64(0))))
    by_a, by_b, by_c = f64(0), f64(0), f64(0)
    if not longest > limits.max_radius:
        by_width = -total[BY_XX] / HALF_LOG2E * c / det  # by a - b^2 / c, the variance along a row of pixels
        by_shear = -two * total[BY_XY] * along / HALF_LOG2E  # by b / c
        by_a = by_width
        by_b = -shear * by_width + half * by_shear / c  # half of it, since b is twice in the covariance
        by_c = shear * shear * by_width - shear * by_shear / c - total[BY_YY] / (c * c)
    by_a += by_blurred
    by_c += by_blurred
    by_p = weighed(two * by_a, p, two * by_b, q, two * by_before, cross(q, normal))
    by_q = weighed(two * by_b, p, two * by_c, q, two * by_before, cross(normal, p))
    # p and q: rows of T R S.
    for axis in range(3):
        row[LOG_SCALE + axis] = by_p[axis] * p[axis] + by_q[axis] * q[axis]
    by_p = (by_p[0] * s[0], by_p[1] * s[1], by_p[2] * s[2])
    by_q = (by_q[0] * s[0], by_q[1] * s[1], by_q[2] * s[2])
    turn_p, turn_q = cross(by_p, p_unit), cross(by_q, q_unit)
    for axis in range(3):
        row[TURN + axis] = turn_p[axis] + turn_q[axis]
    r = rotation
    by_across = (
        dot(by_p, (r[0], r[1], r[2])),
        dot(by_p, (r[3], r[4], r[5])),
        dot(by_p, (r[6], r[7], r[8])),
    )
    by_down = (
        dot(by_q, (r[0], r[1], r[2])),
        dot(by_q, (r[3], r[4], r[5])),
        dot(by_q, (r[6], r[7], r[8])),
    )
    # T: rows of the Jacobian times the rotation into the camera.
    right, below, ahead = (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    by_jx, by_kx = dot(by_across, right), dot(by_across, ahead)
    by_jy, by_ky = dot(by_down, below), dot(by_down, ahead)
    by_x = -two * along / HALF_LOG2E * total[BY_X]
    by_y = -shear * by_x - two * f64(seen[ACROSS]) / HALF_LOG2E * total[BY_Y]
    by_u = by_x * jx - by_kx * jx * inverse
    by_v = by_y * jy - by_ky * jy * inverse
    by_w = by_x * kx + by_y * ky - (by_jx * jx + by_jy * jy) * inverse - two * (by_kx * kx + by_ky * ky) * inverse
    by_center = weighed(by_u, right, by_v, below, by_w, ahead)
    for axis in range(3):
        row[CENTER + axis] = by_center[axis]
