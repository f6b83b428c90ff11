"""Kernels that draw a picture on a card: colours, projection, lists of tiles, and blending.

Projection, culling, falloff and spherical harmonics are those of `render.kernels`, compiled for the card.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from ...model.falloff import merged, plain, shifted
from ...system.jit import b1, f4, i2, i4, i8, kernel, out, u8
from ...system.jit_cuda import cuda_kernel
from ..kernels.ellipse import Lens, Limits
from ..kernels.project import (
    BLUE,
    COLUMNS,
    GREEN,
    HALF_HEIGHT,
    HALF_WIDTH,
    LEAST,
    MAX_INDEX,
    NOT_DRAWN,
    OPACITY,
    POWER,
    RED,
    TILE,
    ShadedColumns,
    X,
    Y,
    exponent,
    index_of,
    project_splat,
    tiles_of,
)
from ..kernels.raster import OPAQUE
from ..kernels.shade import add_sh_of

f32 = np.float32

#: Threads of a block that draws a tile, one for each pixel.
PIXELS = TILE * TILE

#: Splats of a tile that are fetched together, one for each thread.
BATCH = PIXELS


@kernel(inline=True)
def lens_of(view):
    """Return the `Lens` of a view."""
    return Lens(view[0], view[1], view[2], view[3], view[4], view[5])


@kernel(inline=True)
def limits_of(view):
    """Return the `Limits` of a view."""
    return Limits(view[6], view[7], view[8], view[9], view[10], view[11], view[12], view[13])


@cuda_kernel(
    *(f4[:, :], f4[:, :], f4[:, :], f4[:], f4[:, :], f4[:, :, :], i8, i4[:]),
    *(f4[:], f4[:, :], f4[:], b1, out(f4[:, :]), out(f4[:, :]), out(u8[:]), out(i2[:, :]), out(i4[:])),
)
def project(
    center,
    scale,
    quat,
    lod_opacity,
    rgb,
    sh,
    degree,
    index,
    eye,
    matrix,
    view,
    radial,
    colors,
    screen,
    keys,
    boxes,
    count,
):
    """Shade splats and project them onto the screen; `screen`, `keys` and `boxes` are as in `kernels.project.project`.

    Args:
        center, scale, quat, lod_opacity, rgb, sh: columns of N splats, of which the M of `index` are drawn.
        eye: (3,) position of the camera. matrix: (3, 4) world to camera. view: numbers of `Lens` and `Limits`.
        radial: splats are sorted by distance from the camera, not by depth.
        colors: (N, 3) filled for the M splats: what the camera sees.
        count: (M,) tiles that each overlaps, 0 if it is not drawn.
    """
    i = cuda.grid(1)
    if i >= index.shape[0]:
        return
    node = index[i]
    for c in range(3):
        colors[node, c] = rgb[node, c]
    if degree > 0:
        add_sh_of(node, center, sh, eye, degree, colors)
    for c in range(3):
        colors[node, c] = max(colors[node, c], f32(0))
    lens, limits = lens_of(view), limits_of(view)
    splats = ShadedColumns(center, scale, quat, lod_opacity, colors)
    depth = project_splat(splats, node, matrix, lens, limits, radial, screen[i])
    if depth < f32(0):
        keys[i], count[i] = NOT_DRAWN, 0
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, -1, 0, -1
        return
    across, down = (np.int64(lens.width) + TILE - 1) // TILE, (np.int64(lens.height) + TILE - 1) // TILE
    left, right, top, bottom = tiles_of(screen[i], across, down)
    boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = left, right, top, bottom
    count[i] = max(right - left + 1, 0) * max(bottom - top + 1, 0)
    keys[i] = (np.uint64(np.float32(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(MAX_INDEX - i)


@cuda_kernel(u8[:], i4[:], out(i8[:]))
def count_in_order(keys, count, ends):
    """Fill (M,) numbers of tiles of splats in the order of their sorted keys; their sums follow."""
    k = cuda.grid(1)
    if k < keys.shape[0]:
        ends[k] = 0 if keys[k] == NOT_DRAWN else count[index_of(keys[k])]


@cuda_kernel(u8[:], i2[:, :], i8[:], i8, out(u8[:]))
def list_pairs(keys, boxes, ends, across, pairs):
    """List the tiles of each splat: tile in the upper half of a number, rank of the splat from the front in the lower.

    `keys` are sorted; `ends` (M,) are the running sums of `count_in_order`; `pairs` has (ends[-1],) numbers.
    """
    k = cuda.grid(1)
    if k >= keys.shape[0] or keys[k] == NOT_DRAWN:
        return
    box = boxes[index_of(keys[k])]
    at = ends[k - 1] if k > 0 else 0
    for y in range(box[2], box[3] + 1):
        for x in range(box[0], box[1] + 1):
            pairs[at] = (np.uint64(y * across + x) << np.uint64(32)) | np.uint64(k)
            at += 1


@cuda_kernel(u8[:], out(i8[:]))
def find_starts(pairs, start):
    """Fill (T + 1,) where the pairs of each tile begin, of at least one sorted pair."""
    k = cuda.grid(1)
    if k >= pairs.shape[0]:
        return
    tile = np.int64(pairs[k] >> np.uint64(32))
    before = np.int64(pairs[k - 1] >> np.uint64(32)) if k > 0 else -1
    for each in range(before + 1, tile + 1):
        start[each] = k
    if k == pairs.shape[0] - 1:
        for each in range(tile + 1, start.shape[0]):
            start[each] = k + 1


@kernel(inline=True)
def pixel_of(thread):
    """Return the column and row in its tile of a thread's pixel; a warp has 8 x 4 pixels."""
    warp, lane = thread // 32, thread % 32
    return warp % 2 * 8 + lane % 8, warp // 2 * 4 + lane // 8


@cuda_kernel(f4[:, :], u8[:], i8[:], u8[:], i8, b1, f4, out(f4[:, :, :]))
def blend(screen, keys, start, pairs, across, design, least, image):
    """Blend the splats of a tile, a block for each, from near to far; see `kernels.raster.draw_tiles`.

    A pixel ends where it is opaque, and a tile where all its pixels are.
    """
    rows = cuda.shared.array((BATCH, COLUMNS), np.float32)
    tile, thread = cuda.blockIdx.x, cuda.threadIdx.x
    i, line = pixel_of(thread)
    x, y = tile % across * TILE + i, tile // across * TILE + line
    is_inside = x < image.shape[1] and y < image.shape[0]
    through, red, green, blue = f32(1) if is_inside else f32(0), f32(0), f32(0), f32(0)
    end = start[tile + 1]
    for entry in range(start[tile], end, BATCH):
        if cuda.syncthreads_count(np.int32(through < OPAQUE)) == PIXELS:
            break
        count = min(BATCH, end - entry)
        for k in range(thread // COLUMNS, count, PIXELS // COLUMNS):
            of = index_of(keys[np.int64(pairs[entry + k] & np.uint64(MAX_INDEX))])
            rows[k, thread % COLUMNS] = screen[of, thread % COLUMNS]
        cuda.syncthreads()
        for k in range(count):
            if through < OPAQUE:
                break
            row = rows[k]
            dx, dy = f32(x) + f32(0.5) - row[X], f32(y) + f32(0.5) - row[Y]
            if abs(dx) > row[HALF_WIDTH] + f32(1) or abs(dy) > row[HALF_HEIGHT] + f32(1):
                continue
            t = exponent(row, dx, dy)
            if t < row[LEAST]:
                continue
            alpha = alpha_of(t, row[OPACITY], row[POWER], design, least)
            red += through * min(alpha * row[RED], f32(1))
            green += through * min(alpha * row[GREEN], f32(1))
            blue += through * min(alpha * row[BLUE], f32(1))
            through -= through * alpha
    if is_inside:
        image[y, x, 0], image[y, x, 1], image[y, x, 2], image[y, x, 3] = red, green, blue, f32(1) - through


@kernel(inline=True)
def alpha_of(t, d, power, design, least):
    """Return alpha of a splat; merged splats fainter than `least` are not drawn."""
    if d <= f32(1):
        return plain(t)
    alpha = shifted(t, d) if design else merged(t, power)
    return alpha if alpha >= least else f32(0)
