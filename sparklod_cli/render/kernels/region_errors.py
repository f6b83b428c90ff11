"""Draws each region of a scene alone, at each of its detail levels, and compares the pictures.

The pictures are small: each is drawn by one thread, and threads draw pictures of different regions and views.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...system.jit import f4, f8, i8, kernel, out
from .ellipse import Lens, Limits
from .project import COLUMNS, TILE, ShadedColumns, project_splat, tiles_of
from .raster import LANES, draw_tile

f32 = np.float32

#: Bits of a depth that one pass of the radix sort sorts by. Chosen: depths of a region differ in the last 17 or 18 bits
#: of a float32, which are two passes.
DIGIT_BITS = 9


class View(NamedTuple):
    """View of a region."""

    world_to_camera: Any  # (3, 4) float32, which also scales
    basis: Any  # (K,) float32 values of the spherical harmonics in the direction of the view
    lens: Any  # `Lens` of a square picture
    limits: Any  # `Limits`


@kernel(
    i8,
    ShadedColumns,
    f4[:, :, :],
    i8[:, :, :],
    f4[:, :, :, :],
    f4[:, :],
    i8[:],
    f4,
    Limits,
    out(f8[:, :, :]),
    ranges=True,
    contract=True,
)
def compare_levels(begin, end, splats, sh, runs, poses, basis, sizes, focal, limits, differences):
    """Sum squared differences between pictures of regions at their detail levels and at the first.

    Args:
        splats: of all levels, with colours that lack the spherical harmonics of degree 1 and above.
        sh: (N, K, 3) coefficients of these.
        runs: (R, L, 2) first splat and number of splats of each region at each level.
        poses: (R, V, 3, 4) world to camera.
        basis: (V, K) values of the spherical harmonics in the direction of each view.
        sizes: (R,) width and height of each region's pictures, a multiple of TILE.
        focal: focal length, in widths of the picture.
        differences: (R, V, L) filled with sums over pixels and channels; for level 0 with the sum of its own squares,
            and for a level without splats with 0.
    """
    regions = len(poses)
    for job in range(begin, end):
        # All regions of a view, then the next view: threads get equal shares of large regions.
        region, view = job % regions, job // regions
        size = sizes[region]
        width = f32(size)
        lens = Lens(focal * width, focal * width, width / f32(2), width / f32(2), width, width)
        seen = View(poses[region, view], basis[view], lens, limits)
        screen = np.empty((runs[region, :, 1].max(), COLUMNS), np.float32)
        first, other = np.zeros((size, size, 4), np.float32), np.zeros((size, size, 4), np.float32)
        for level in range(runs.shape[1]):
            start, count = runs[region, level]
            drawn = project_run(splats, sh, start, count, seen, screen)
            draw_run(screen[:drawn], size // TILE, limits.min_alpha, other)
            differences[region, view, level] = squared_difference(first, other) if count else 0.0
            if level == 0:
                first, other = other, first


@kernel()
def project_run(splats, sh, start, count, view, screen):
    """Fill the rows of `screen` with the splats of a run that are drawn, from near to far; return their number."""
    stop = start + count
    rgb = splats.rgb[start:stop].copy()
    for i in range(count):
        for k in range(sh.shape[1]):
            for channel in range(3):
                rgb[i, channel] += view.basis[k] * sh[start + i, k, channel]
    run = ShadedColumns(
        splats.center[start:stop],
        splats.scale[start:stop],
        splats.quat_xyzw[start:stop],
        splats.lod_opacity[start:stop],
        rgb,
    )
    drawn = 0
    for i in by_depth(run.center, view.world_to_camera):
        if project_splat(run, i, view.world_to_camera, view.lens, view.limits, False, screen[drawn]) >= 0:
            drawn += 1
    return drawn


@kernel()
def by_depth(center, world_to_camera):
    """Return (n,) int32 rows of (n, 3) centres in front of a camera, from near to far; of equal depths the last."""
    m, n = world_to_camera, len(center)
    keys, order = np.empty(n, np.uint32), np.empty(n, np.int32)
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    for k in range(n):
        i = n - 1 - k
        depth = m[2, 0] * center[i, 0] + m[2, 1] * center[i, 1] + m[2, 2] * center[i, 2] + m[2, 3]
        order[k], keys[k] = i, np.float32(depth).view(np.uint32)
        low, high = min(low, keys[k]), max(high, keys[k])
    keys -= low
    left = np.int64(high) - np.int64(low)
    shift = 0
    while left > 0:
        keys, order = digit_sorted(keys, order, shift)
        shift += DIGIT_BITS
        left >>= DIGIT_BITS
    return order


@kernel()
def digit_sorted(keys, values, shift):
    """Sort keys and values stably by DIGIT_BITS bits of the keys, from bit `shift` on."""
    at = np.zeros((1 << DIGIT_BITS) + 1, np.int64)
    mask = np.uint32((1 << DIGIT_BITS) - 1)
    shift = np.uint32(shift)
    for key in keys:
        at[np.int64((key >> shift) & mask) + 1] += 1
    for digit in range(1 << DIGIT_BITS):
        at[digit + 1] += at[digit]
    keys_out, values_out = np.empty_like(keys), np.empty_like(values)
    for i in range(len(keys)):
        digit = np.int64((keys[i] >> shift) & mask)
        keys_out[at[digit]], values_out[at[digit]] = keys[i], values[i]
        at[digit] += 1
    return keys_out, values_out


@kernel(inline_late=True)
def draw_run(screen, tiles, least, picture):
    """Draw splats on the screen, from near to far, into a square picture of `tiles` tiles along each side."""
    start = np.zeros(tiles * tiles + 1, np.int64)
    for i in range(len(screen)):
        left, right, top, bottom = tiles_of(screen[i], tiles, tiles)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                start[y * tiles + x + 1] += 1
    for tile in range(tiles * tiles):
        start[tile + 1] += start[tile]
    at, splats = start[:-1].copy(), np.empty(start[-1], np.int32)
    for i in range(len(screen)):
        left, right, top, bottom = tiles_of(screen[i], tiles, tiles)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                splats[at[y * tiles + x]] = i
                at[y * tiles + x] += 1
    for tile in range(tiles * tiles):
        draw_tile(screen, start, splats, tile, tiles, False, least, picture)


@kernel()
def squared_difference(picture, other):
    """Return the sum of the squared differences of two pictures, over pixels and channels, in float64."""
    a, b = picture.reshape(-1, LANES), other.reshape(-1, LANES)
    sums = np.zeros(LANES)
    for i in range(len(a)):
        for lane in range(LANES):
            difference = np.float64(a[i, lane]) - np.float64(b[i, lane])
            sums[lane] += difference * difference
    return sums.sum()
