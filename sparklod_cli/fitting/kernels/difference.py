"""How far a picture is from another on a black and a white background, and the derivative of that."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import f4, f8, out

f32 = np.float32
ZERO, ONE = f32(0), f32(1)


@kernel(inline=True)
def clipped(value):
    """A colour value as a picture shows it."""
    return min(max(value, ZERO), ONE)


@kernel(f4[:, :, :], f4[:, :, :], out(f8[:, :]), parallel=True)
def squared_differences(image, full, sums):
    """Sums of squared differences over the pixels of each row.

    Args:
        image, full: (H, W, 4) float32, colours multiplied by alpha, and alpha.
        sums: (H, 2) float64, filled: on black and on white.
    """
    height, width = image.shape[:2]
    for y in prange(height):
        black, white = 0.0, 0.0
        for x in range(width):
            behind, full_behind = ONE - image[y, x, 3], ONE - full[y, x, 3]
            for c in range(3):
                a, b = image[y, x, c], full[y, x, c]
                on_black = clipped(a) - clipped(b)
                on_white = clipped(a + behind) - clipped(b + full_behind)
                black += on_black * on_black
                white += on_white * on_white
        sums[y, 0] = black
        sums[y, 1] = white


@kernel(f4[:, :, :], f4[:, :, :], f4, f4, out(f4[:, :, :]), parallel=True)
def by_image(image, full, on_black, on_white, result):
    """The derivative of `on_black` and `on_white` times the halves of the squared differences on either background.

    A value that is clipped counts only if it is to come back.

    Args:
        image, full: of `squared_differences`.
        on_black, on_white: float32.
        result: (H, W, 4) float32, filled: derivative by each value of `image`.
    """
    height, width = image.shape[:2]
    for y in prange(height):
        for x in range(width):
            behind, full_behind = ONE - image[y, x, 3], ONE - full[y, x, 3]
            by_alpha = ZERO
            for c in range(3):
                a, b = image[y, x, c], full[y, x, c]
                black = on_black * (clipped(a) - clipped(b))
                white = on_white * (clipped(a + behind) - clipped(b + full_behind))
                result[y, x, c] = black + white
                by_alpha -= white
            result[y, x, 3] = by_alpha
