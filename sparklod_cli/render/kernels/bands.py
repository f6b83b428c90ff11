"""Draws discs and counts fragments in ranges of a picture's rows."""

from __future__ import annotations

import math

import numpy as np

from ...model.falloff import alpha_at
from ...system.jit import kernel
from ...system.jit_types import b1, f4, i4, i8, out, u8
from .project import HALF_HEIGHT, HALF_WIDTH, LEAST, OPACITY, POWER, X, Y, exponent, index_of

f32 = np.float32


@kernel(i8, f4[:], f4[:], f4[:], f4[:, :], f4, out(f4[:, :, :]), ranges=True)
def draw_discs(top, bottom, x, y, radius, rgb, alpha, image):
    """Blend discs on a picture in their order, each over those before it; centres and radii in pixels."""
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
