"""The transforms of lossless WebP (RFC 9649, section 4), undone channel by channel, as the RFC words them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.int64]


def channels(pixels: NDArray[np.uint32]) -> Image:
    """(..., 4) channels A R G B of (...) pixels."""
    return np.stack([pixels >> np.uint32(shift) & np.uint32(255) for shift in (24, 16, 8, 0)], axis=-1).astype(np.int64)


def joined(image: Image) -> NDArray[np.uint32]:
    """(...) pixels of (..., 4) channels A R G B."""
    return (image << np.array([24, 16, 8, 0])).sum(axis=-1).astype(np.uint32)


def predicted(mode: int, left: Image, up: Image, right: Image, corner: Image) -> Image:
    """What a mode predicts of a pixel: from the one to its left, above, above to the right, above to the left."""
    mean = [
        np.array([255, 0, 0, 0]),
        left,
        up,
        right,
        corner,
        ((left + right) // 2 + up) // 2,
        (left + corner) // 2,
        (left + up) // 2,
        (corner + up) // 2,
        (up + right) // 2,
        ((left + corner) // 2 + (up + right) // 2) // 2,
    ]
    if mode < len(mean):
        return mean[mode]
    if mode == 11:
        guess = left + up - corner
        return left if np.abs(guess - left).sum() < np.abs(guess - up).sum() else up
    if mode == 12:
        return np.clip(left + up - corner, 0, 255)
    if mode == 13:
        middle = (left + up) // 2
        return np.clip(middle + np.trunc((middle - corner) / 2).astype(np.int64), 0, 255)
    return mean[0]


def unpredicted(image: Image, modes: Image, shift: int) -> Image:
    """(H, W, 4) of the differences to what is predicted; `modes` has a pixel for each tile, whose green is the mode."""
    out = image.copy()
    height, width = image.shape[:2]
    for y in range(height):
        for x in range(width):
            if y == 0:
                guess = out[0, x - 1] if x else np.array([255, 0, 0, 0])
            elif x == 0:
                guess = out[y - 1, 0]
            else:
                right = out[y - 1, x + 1] if x + 1 < width else out[y, 0]
                mode = int(modes[y >> shift, x >> shift, 2]) & 15
                guess = predicted(mode, out[y, x - 1], out[y - 1, x], right, out[y - 1, x - 1])
            out[y, x] = (image[y, x] + guess) % 256
    return out


def signed(byte: int) -> int:
    """A byte in two's complement."""
    return byte - 256 if byte > 127 else byte


def uncorrelated(image: Image, factors: Image, shift: int) -> Image:
    """(H, W, 4) of which red and blue get what they have of green, and blue of red."""
    out = image.copy()
    for y in range(len(image)):
        for x in range(image.shape[1]):
            _, red_blue, green_blue, green_red = (signed(int(each)) for each in factors[y >> shift, x >> shift])
            green = signed(int(image[y, x, 2]))
            red = (image[y, x, 1] + (green_red * green >> 5)) % 256
            blue = image[y, x, 3] + (green_blue * green >> 5) + (red_blue * signed(int(red)) >> 5)
            out[y, x, 1], out[y, x, 3] = red, blue % 256
    return out
