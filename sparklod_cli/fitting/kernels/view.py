"""Kernels for visible nodes, and for the differences of pictures and their derivatives."""

from __future__ import annotations

import numpy as np

from ...render.kernels.ellipse import Lens, Limits
from ...system.jit import b1, f4, f8, i8, kernel, out, u2

f32 = np.float32

ZERO, ONE = f32(0), f32(1)

#: Unit of the values of pictures of full detail, in 16 bits.
LEVEL = f32(1 / 65535)


@kernel(i8, f4[:, :], f4[:], i8[:], f4[:, :], Lens, Limits, out(b1[:]), ranges=True)
def mark_seen(start, stop, center, lod_opacity, index, world_to_camera, lens, limits, seen):
    """Mark the nodes of `index` that `project` may draw: between near and far, with a centre in or near the picture."""
    m = world_to_camera
    half_width, half_height = f32(0.5) * lens.width, f32(0.5) * lens.height
    for i in range(start, stop):
        at = index[i]
        x, y, z = center[at, 0], center[at, 1], center[at, 2]
        w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        visible = False
        if w > limits.near and w < limits.far and lod_opacity[at] >= limits.min_alpha:
            u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            inverse = f32(1) / w
            dx, dy = lens.focal_x * u * inverse, lens.focal_y * v * inverse
            visible = (
                abs(lens.principal_x + dx - half_width) <= limits.clip * half_width
                and abs(lens.principal_y + dy - half_height) <= limits.clip * half_height
            )
        seen[i] = visible


@kernel(inline=True)
def clipped(value):
    """Return a colour value as a picture shows it."""
    return min(max(value, ZERO), ONE)


@kernel(inline=True)
def differences(image, full, y, x, c):
    """Return the differences of a colour from full detail, on black and on white."""
    a, b = image[y, x, c], LEVEL * f32(full[y, x, c])
    behind, full_behind = ONE - image[y, x, 3], ONE - LEVEL * f32(full[y, x, 3])
    return clipped(a) - clipped(b), clipped(a + behind) - clipped(b + full_behind)


@kernel(i8, f4[:, :, :], u2[:, :, :], out(f8[:, :]), ranges=True)
def squared_differences(start, stop, image, full, sums):
    """Fill (H, 2) sums of squared differences over the pixels of each row, on black and on white.

    Args:
        image: (H, W, 4) colours multiplied by alpha, and alpha.
        full: (H, W, 4) the same in units of `LEVEL`.
    """
    width = image.shape[1]
    for y in range(start, stop):
        black, white = 0.0, 0.0
        for x in range(width):
            for c in range(3):
                on_black, on_white = differences(image, full, y, x, c)
                black += on_black * on_black
                white += on_white * on_white
        sums[y, 0] = black
        sums[y, 1] = white


@kernel(inline=True)
def by_pixel(image, full, y, x, on_black, on_white, result):
    """Fill the derivatives by a pixel; see `by_image`."""
    by_alpha = ZERO
    for c in range(3):
        black, white = differences(image, full, y, x, c)
        result[y, x, c] = on_black * black + on_white * white
        by_alpha -= on_white * white
    result[y, x, 3] = by_alpha


@kernel(i8, f4[:, :, :], u2[:, :, :], f4, f4, out(f4[:, :, :]), ranges=True)
def by_image(start, stop, image, full, on_black, on_white, result):
    """Fill the derivative of half the squared differences on either background, times `on_black` and `on_white`.

    It is (H, W, 4), by each value of `image`. A clipped value counts only if it has to return.
    """
    width = image.shape[1]
    for y in range(start, stop):
        for x in range(width):
            by_pixel(image, full, y, x, on_black, on_white, result)
