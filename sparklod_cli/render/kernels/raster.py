"""Splats in tiles, and tiles into pixels."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ...support.fast_math import exp2, log2
from ...support.jit import kernel
from .project import BLUE, END, GREEN, HALF_HEIGHT, HALF_WIDTH, OPACITY, POWER, RED, A, B, C, X, Y

f32 = np.float32

#: Sides of a tile, pixels, and how many of a row are blended at once: a vector of AVX2.
TILE, LANES = 16, 8

#: A tile is done when no pixel lets through more than this; it is looked at after so many splats.
OPAQUE, PATIENCE = f32(1e-4), 16


@kernel(inline=True)
def tiles_of(row, across, down):
    """First and last tile on each axis that the box of a splat touches."""
    left = max(0, math.floor((row[X] - row[HALF_WIDTH]) / TILE))
    right = min(across - 1, math.floor((row[X] + row[HALF_WIDTH]) / TILE))
    top = max(0, math.floor((row[Y] - row[HALF_HEIGHT]) / TILE))
    bottom = min(down - 1, math.floor((row[Y] + row[HALF_HEIGHT]) / TILE))
    return left, right, top, bottom


@kernel(parallel=True)
def sort_into_tiles(screen, across, down, chunks):
    """Which splats each tile has, in their order.

    Args:
        screen: (N, COLUMNS) of `project`, from near to far.
        across, down: how many tiles there are.
        chunks: pieces to work in; the result does not depend on it.

    Returns:
        start: (tiles + 1,) int64, where the splats of each tile begin.
        splats: (total,) int32 rows of `screen`.
    """
    tiles = across * down
    count = np.zeros((chunks, tiles), np.int32)
    n = len(screen)
    for chunk in prange(chunks):
        for i in range(n * chunk // chunks, n * (chunk + 1) // chunks):
            left, right, top, bottom = tiles_of(screen[i], across, down)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    count[chunk, y * across + x] += 1
    start = np.empty(tiles + 1, np.int64)
    at = np.empty((chunks, tiles), np.int64)
    total = 0
    for tile in range(tiles):
        start[tile] = total
        for chunk in range(chunks):
            at[chunk, tile] = total
            total += count[chunk, tile]
    start[tiles] = total
    splats = np.empty(total, np.int32)
    for chunk in prange(chunks):
        for i in range(n * chunk // chunks, n * (chunk + 1) // chunks):
            left, right, top, bottom = tiles_of(screen[i], across, down)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    tile = y * across + x
                    splats[at[chunk, tile]] = i
                    at[chunk, tile] += 1
    return start, splats


HALF_LOG2E = f32(-0.7213475204444817)
LOG2E = f32(1.4426950408889634)


@kernel(inline=True)
def plain(z2, opacity):
    """Alpha of a splat with D up to 1: D * exp(-z^2 / 2)."""
    return opacity * exp2(HALF_LOG2E * z2)


@kernel(inline=True)
def merged(z2, power):
    """Alpha of a splat with D above 1: 1 - (1 - exp(-z^2 / 2)) ** power."""
    rest = max(f32(1) - exp2(HALF_LOG2E * z2), f32(1e-30))
    return f32(1) - exp2(max(power * log2(rest), f32(-120)))


@kernel(inline=True)
def shifted(z2, opacity):
    """Alpha of a splat with D above 1 in Spark's LoD design: exp(-D / 2 * max(0, z - (D - 1)) ** 2)."""
    beyond = max(np.sqrt(max(z2, f32(0))) - (opacity - f32(1)), f32(0))
    return exp2(HALF_LOG2E * opacity * beyond * beyond)


@kernel(inline=True)
def blend(pixels, i, alpha, inside, least, red, green, blue):
    """Puts a splat behind what a pixel has; without branches, so that a row of pixels is one vector.

    Colours are cut where a picture of 8 bits cuts them, after they are multiplied by alpha.
    """
    alpha = alpha if inside & (alpha >= least) else f32(0)
    through = pixels[0, i]
    pixels[1, i] += through * min(alpha * red, f32(1))
    pixels[2, i] += through * min(alpha * green, f32(1))
    pixels[3, i] += through * min(alpha * blue, f32(1))
    pixels[0, i] = through - through * alpha


@kernel(inline=True)
def blend_lanes(pixels, row, x, dy, design, least):
    """Blends a splat into pixels side by side.

    Args:
        pixels: (4, LANES) float32: what is let through, then red, green and blue.
        row: of `screen`.
        x: its centre from the middle of the first pixel.
        dy: from its centre to the pixels.
        design: D above 1 falls off as in Spark's LoD design.
        least: less alpha than this is not drawn.
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
    """Whether nothing that comes behind can be seen."""
    most = f32(0)
    for line in range(rows):
        for i in range(columns):
            most = max(most, pixels[line, i // LANES, 0, i % LANES])
    return most < OPAQUE


@kernel(parallel=True, contract=True)
def draw_tiles(screen, start, splats, across, down, design, least, image):
    """Blends the splats of each tile, from near to far.

    Args:
        screen, start, splats: of `sort_into_tiles`.
        across, down: how many tiles there are.
        design: D above 1 falls off as in Spark's LoD design.
        least: less alpha than this is not drawn, float32.
        image: (height, width, 4) float32, filled: red, green and blue, multiplied by alpha, and alpha.
    """
    height, width = image.shape[:2]
    for tile in prange(across * down):
        left, top = tile % across * TILE, tile // across * TILE
        pixels = np.zeros((TILE, TILE // LANES, 4, LANES), np.float32)
        pixels[:, :, 0] = 1
        rows = min(TILE, height - top)
        columns = min(TILE, width - left)
        for entry in range(start[tile], start[tile + 1]):
            row = screen[splats[entry]]
            x, y = row[X] - f32(left) - f32(0.5), row[Y] - f32(top) - f32(0.5)
            first = max(0, math.ceil(y - row[HALF_HEIGHT]))
            last = min(rows, math.floor(y + row[HALF_HEIGHT]) + 1)
            begin = max(0, math.ceil(x - row[HALF_WIDTH])) // LANES
            end = (min(columns, math.floor(x + row[HALF_WIDTH]) + 1) + LANES - 1) // LANES
            for line in range(first, last):
                for block in range(begin, end):
                    blend_lanes(pixels[line, block], row, x - f32(LANES * block), f32(line) - y, design, least)
            if (entry - start[tile]) % PATIENCE == PATIENCE - 1 and is_opaque(pixels, rows, columns):
                break
        for line in range(rows):
            for i in range(columns):
                lanes = pixels[line, i // LANES]
                image[top + line, left + i, 0] = lanes[1, i % LANES]
                image[top + line, left + i, 1] = lanes[2, i % LANES]
                image[top + line, left + i, 2] = lanes[3, i % LANES]
                image[top + line, left + i, 3] = f32(1) - lanes[0, i % LANES]
