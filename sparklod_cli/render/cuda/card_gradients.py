"""The backward pass on a card, with the formulas of `kernels.backward`.

No two threads write to the same place, and all sums have a fixed order, so that gradients are the same every time: each
tile writes a row of sums for each of its splats, which are added in the order of the splat's tiles.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from ...model.falloff import MIN_ALPHA, merged_slopes, plain_slopes
from ...system.jit import f4, f8, i2, i4, i8, kernel, out, u8
from ...system.jit_cuda import SIMULATED, cuda_kernel
from .. import rasterizer
from ..kernels.backward import (
    BY_BLUE,
    BY_GREEN,
    BY_RED,
    BY_SHAPE,
    BY_X,
    BY_XX,
    BY_XY,
    BY_Y,
    BY_YY,
    GRADIENT_COLUMNS,
    LEAST_THROUGH,
    SUMS,
    carry_splat_back,
)
from ..kernels.project import (
    ACROSS,
    ALONG,
    BLUE,
    COLUMNS,
    GREEN,
    LEAST,
    LOG,
    MAX_INDEX,
    OPACITY,
    POWER,
    RED,
    SHEAR,
    TILE,
    ShadedColumns,
    X,
    Y,
    index_of,
)
from ..kernels.raster import OPAQUE
from .card import CardArray
from .card_rasterizer import CardPicture, CardSplats, CardView
from .forward import PIXELS, lens_of, limits_of, pixel_of

f32, f64 = np.float32, np.float64

#: Threads of a warp, and warps of a tile.
WARP = 32
WARPS = PIXELS // WARP

#: Splats of a tile whose sums are kept until all warps have theirs: 9 KB of shared memory. Chosen.
BATCH = 32

#: Threads of a block that adds up rows, a warp for each splat.
ADDERS = 4 * WARP

#: Shared memory with which the simulator replaces the instructions of warps.
SCRATCH = (PIXELS if SIMULATED else 1, SUMS)

#: All lanes of a warp.
ALL = 0xFFFFFFFF


@kernel(inline=True)
def any_of_warp(flag):
    """Return whether `flag` is set in any lane of a warp."""
    return cuda.any_sync(ALL, flag)


@kernel(inline=True)
def add_warp(values, scratch, thread):
    """Add up values over the lanes of each warp, in a fixed order; the first lane has the sums."""
    for column in range(SUMS):
        value = values[column]
        value += cuda.shfl_down_sync(ALL, value, 16)
        value += cuda.shfl_down_sync(ALL, value, 8)
        value += cuda.shfl_down_sync(ALL, value, 4)
        value += cuda.shfl_down_sync(ALL, value, 2)
        value += cuda.shfl_down_sync(ALL, value, 1)
        values[column] = value


if SIMULATED:  # which has no instructions of warps: the same sums by shared memory, for which all threads meet

    @kernel(inline=True)
    def any_of_warp(flag):
        """Return True: all threads take part in `add_warp`."""
        return True

    @kernel(inline=True)
    def add_warp(values, scratch, thread):
        """Add up values over the lanes of each warp, in the order of the real one."""
        scratch[thread] = values
        cuda.syncthreads()
        if thread % WARP == 0:
            lanes = scratch[thread : thread + WARP].copy()
            for half in (16, 8, 4, 2, 1):
                lanes = lanes[:half] + lanes[half : 2 * half]
            values[:] = lanes[0]
        cuda.syncthreads()


@cuda_kernel(
    *(f4[:, :], u8[:], i2[:, :], i8[:], i8[:], u8[:], i8, f4, f4[:, :, :], f4[:, :, :], out(f4[:, :])),
)
def weigh_tiles(screen, keys, boxes, ends, start, pairs, across, least, image, by_image, sums):
    """Sum for each splat over the pixels of each tile that its box overlaps, a block for each tile.

    Args:
        screen, keys, boxes, ends, start, pairs, across, least, image: of `forward`.
        by_image: (height, width, 4) derivatives of the loss by the image.
        sums: (ends[-1], SUMS) filled, the rows of a splat after those of the splats in front of it.
    """
    rows = cuda.shared.array((BATCH, COLUMNS), np.float32)
    at = cuda.shared.array(BATCH, np.int64)
    parts = cuda.shared.array((BATCH, WARPS, SUMS), np.float32)
    scratch = cuda.shared.array(SCRATCH, np.float32)
    values = cuda.local.array(SUMS, np.float32)
    tile, thread = cuda.blockIdx.x, cuda.threadIdx.x
    i, line = pixel_of(thread)
    x, y = tile % across * TILE + i, tile // across * TILE + line
    is_inside = x < image.shape[1] and y < image.shape[0]
    through, rest, of_red, of_green, of_blue = f32(0), f32(0), f32(0), f32(0), f32(0)
    if is_inside:
        through = f32(1)
        of_red, of_green, of_blue, of_alpha = by_image[y, x, 0], by_image[y, x, 1], by_image[y, x, 2], by_image[y, x, 3]
        rest = of_red * image[y, x, 0] + of_green * image[y, x, 1] + of_blue * image[y, x, 2]
        rest -= of_alpha * (f32(1) - image[y, x, 3])
    for entry in range(start[tile], start[tile + 1], BATCH):
        # Also the barrier before shared memory is overwritten.
        is_opaque = cuda.syncthreads_count(np.int32(through < OPAQUE)) == PIXELS
        count = min(BATCH, start[tile + 1] - entry)
        for k in range(thread // COLUMNS, count, PIXELS // COLUMNS):
            rank = np.int64(pairs[entry + k] & np.uint64(MAX_INDEX))
            of = index_of(keys[rank])
            rows[k, thread % COLUMNS] = screen[of, thread % COLUMNS]
            if thread % COLUMNS == 0:
                box = boxes[of]
                place = (tile // across - box[2]) * (box[1] - box[0] + 1) + tile % across - box[0]
                at[k] = place + (ends[rank - 1] if rank > 0 else 0)
        cuda.syncthreads()
        for k in range(count):
            row = rows[k]
            dx, dy = f32(x) + f32(0.5) - row[X], f32(y) + f32(0.5) - row[Y]
            v = row[ALONG] * (dx - row[SHEAR] * dy)
            t = row[LOG] - v * v - row[ACROSS] * dy * dy
            is_drawn = not is_opaque and through >= OPAQUE and t >= row[LEAST]
            alpha, by_z2, by_shape = f32(0), f32(0), f32(0)
            if is_drawn:
                if row[OPACITY] <= f32(1):
                    alpha, by_z2, by_shape = plain_slopes(t, f32(1) / row[OPACITY])
                else:
                    alpha, by_z2, by_shape = merged_slopes(t, row[POWER])
                    is_drawn = alpha >= least
            for column in range(SUMS):
                values[column] = f32(0)
            if is_drawn:
                r, g, b = alpha * row[RED], alpha * row[GREEN], alpha * row[BLUE]
                rest -= through * (of_red * min(r, f32(1)) + of_green * min(g, f32(1)) + of_blue * min(b, f32(1)))
                # A colour that is clamped to 1 depends on nothing.
                by_red = of_red if r < f32(1) else f32(0)
                by_green = of_green if g < f32(1) else f32(0)
                by_blue = of_blue if b < f32(1) else f32(0)
                by_alpha = through * (by_red * row[RED] + by_green * row[GREEN] + by_blue * row[BLUE])
                by_alpha -= rest / max(f32(1) - alpha, LEAST_THROUGH)
                along, seen = by_alpha * by_z2, through * alpha
                values[BY_X], values[BY_Y] = along * v, along * dy
                values[BY_XX], values[BY_XY], values[BY_YY] = along * v * v, along * v * dy, along * dy * dy
                values[BY_SHAPE] = by_alpha * by_shape
                values[BY_RED], values[BY_GREEN], values[BY_BLUE] = seen * by_red, seen * by_green, seen * by_blue
                through -= seen
            if any_of_warp(is_drawn):
                add_warp(values, scratch, thread)
            if thread % WARP == 0:
                for column in range(SUMS):
                    parts[k, thread // WARP, column] = values[column]
        cuda.syncthreads()
        for each in range(thread, count * SUMS, PIXELS):
            k, column = each // SUMS, each % SUMS
            total = f32(0)
            for warp in range(WARPS):
                total += parts[k, warp, column]
            sums[at[k], column] = total


@cuda_kernel(u8[:], i4[:], i8[:], f4[:, :], out(f8[:, :]))
def add_rows(keys, count, ends, sums, totals):
    """Fill (M, SUMS) sums of the rows, of `weigh_tiles`, of each splat that is drawn, a warp for each splat."""
    scratch = cuda.shared.array(SCRATCH, np.float64)
    values = cuda.local.array(SUMS, np.float64)
    thread = cuda.threadIdx.x
    rank, lane = cuda.grid(1) // WARP, thread % WARP
    last = ends[rank] if rank < keys.shape[0] else 0
    first = ends[rank - 1] if 0 < rank < keys.shape[0] else 0
    for column in range(SUMS):
        values[column] = f64(0)
    for row in range(first + lane, last, WARP):
        for column in range(SUMS):
            values[column] += f64(sums[row, column])
    add_warp(values, scratch, thread)
    if lane == 0 and first < last:
        of = index_of(keys[rank])
        for column in range(SUMS):
            totals[of, column] = values[column]


@cuda_kernel(
    *(f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :], i4[:]),
    *(f4[:, :], f4[:], f4[:, :], i4[:], f8[:, :], out(f4[:, :])),
)
def carry_back(center, scale, quat, lod_opacity, colors, index, matrix, view, screen, count, totals, gradients):
    """Fill (M, GRADIENT_COLUMNS) derivatives, 0 for splats that are not drawn; see `kernels.backward.carry_back`.

    Arguments are those of `forward.project`, and `totals` of `add_rows`.
    """
    i = cuda.grid(1)
    if i >= index.shape[0]:
        return
    if count[i] == 0:
        for column in range(GRADIENT_COLUMNS):
            gradients[i, column] = f32(0)
        return
    lens, limits = lens_of(view), limits_of(view)
    splats = ShadedColumns(center, scale, quat, lod_opacity, colors)
    carry_splat_back(splats, index[i], matrix, lens, limits, screen[i], totals[i], gradients[i])


def gradients_on_card(splats: CardSplats, picture: CardPicture, view: CardView, by_image: CardArray) -> CardArray:
    """Return (M, GRADIENT_COLUMNS) derivatives of a loss by each of the splats that a picture was drawn of.

    They are the same every time; see `gradients.SplatGradients`. The splats are as they were when the picture was
    drawn, with the profile spark; `by_image` (height, width, 4) are the derivatives of the loss by the picture.
    """
    across, down = rasterizer.tiles_across(view.camera)
    seen, number, new = picture, picture.index.shape[0], splats.memory.array
    sums = new("sums", (seen.pairs.shape[0], SUMS))
    totals = new("totals", (number, SUMS), np.float64)
    gradients = new("gradients", (number, GRADIENT_COLUMNS))
    tiles = seen.boxes, seen.ends, seen.start, seen.pairs, across, np.float32(MIN_ALPHA)
    drawn = seen.screen, seen.keys, *tiles, seen.image, by_image, sums
    weigh_tiles.launch(across * down, PIXELS, *drawn)
    blocks = -(-number * WARP // ADDERS)
    add_rows.launch(blocks, ADDERS, seen.keys, seen.count, seen.ends, sums, totals)
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.colors, seen.index
    results = view.matrix, view.view, seen.screen, seen.count, totals, gradients
    carry_back.for_each(number, *columns, *results)
    return gradients
