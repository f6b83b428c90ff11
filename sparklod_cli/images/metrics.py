"""How far one image is from another: PSNR, SSIM, and the tile that is farthest off."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..support.errors import SparklodError

#: (H, W, C), 0..1.
Image = NDArray[np.floating[Any]]

#: No PSNR is greater, in dB: images that are the same have none, and a table, a mean and an assertion want a number.
#: It is far beyond 59 dB, what rounding to 8 bits leaves of an image.
MOST_PSNR = 100.0

#: Sides of the tiles that are looked at by themselves, pixels.
TILE = 64

#: The window of SSIM (Wang, Bovik, Sheikh and Simoncelli 2004): a Gaussian of this standard deviation, cut to so many
#: pixels, and the constants that keep dark and flat places from dividing by nothing, for images of 0..1.
SIGMA, WINDOW, C1, C2 = 1.5, 11, 0.01**2, 0.03**2

#: Lines that are smoothed at a time: what they need stays in the cache.
STRIP = 32


@dataclass(frozen=True)
class Tile:
    """The tile of an image that differs most.

    Attributes:
        psnr: dB, of the tile alone.
        x, y: its upper left pixel.
    """

    psnr: float
    x: int
    y: int


def check_covered(reference: Image, what: str) -> None:
    """Raises a `SparklodError` where a picture that others are compared with shows nothing: any would be like it.

    Args:
        reference: (H, W, 4), its last channel alpha.
        what: it is a picture of.
    """
    if not (reference[..., 3] > 0).any():
        raise SparklodError(
            f"{what} covers no pixel, so there is nothing to compare with; cameras and scene may not share their axes"
            " (--camera-axes, --world-transform, --up), or --near and --far leave nothing"
        )


def on_background(image: Image, gray: float) -> Image:
    """(H, W, 3), 0..1: an image of which red, green and blue are multiplied by alpha, on a background 0..1."""
    return np.clip(image[..., :3] + np.float32(gray) * (1 - image[..., 3:]), 0, 1)


def psnr_of(mse: float) -> float:
    """dB of a mean square error of images of 0..1; `MOST_PSNR` at most."""
    return min(-10 * math.log10(mse), MOST_PSNR) if mse > 0 else MOST_PSNR


def psnr(a: Image, b: Image) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels and channels; `MOST_PSNR` at most.

    Args:
        a, b: (H, W, C) of the same shape, 0..1.
    """
    return psnr_of(float(np.mean(_squared_error(a, b))))


def worst_tile(a: Image, b: Image, size: int = TILE) -> Tile:
    """The tile with the lowest PSNR; those at the right and the lower edge may be smaller. The first one of several.

    Args:
        a, b: (H, W, C) of the same shape, 0..1.
        size: its sides, pixels.
    """
    error = _squared_error(a, b).mean(axis=2)
    height, width = error.shape
    down, across = np.arange(0, height, size), np.arange(0, width, size)
    sums = np.add.reduceat(np.add.reduceat(error, down, axis=0), across, axis=1)
    pixels = np.minimum(height - down, size)[:, None] * np.minimum(width - across, size)
    mean = sums / pixels
    row, column = divmod(int(np.argmax(mean)), len(across))
    return Tile(psnr_of(float(mean[row, column])), column * size, row * size)


def ssim(a: Image, b: Image) -> float:
    """Structural similarity, 1 for images that are the same: the mean over the places that a whole window fits into.

    The one of Wang et al. 2004, of each channel by itself. Where a side is shorter than the window, it is shortened.

    Args:
        a, b: (H, W, C) of the same shape, 0..1.
    """
    taps = [_taps(min(WINDOW, side)) for side in a.shape[:2]]
    rows = a.shape[0] - len(taps[0]) + 1
    total, count = 0.0, 0
    for start in range(0, rows, STRIP):
        lines = slice(start, min(start + STRIP, rows) + len(taps[0]) - 1)
        part = _similarity(np.asarray(a[lines], np.float64), np.asarray(b[lines], np.float64), taps)
        total += float(part.sum())
        count += part.size
    return total / count


def _similarity(a: Image, b: Image, taps: list[NDArray[np.float64]]) -> Image:
    """SSIM of each place that a whole window fits into."""
    mean_a, mean_b = _smoothed(a, taps), _smoothed(b, taps)
    square_a, square_b, product = mean_a * mean_a, mean_b * mean_b, mean_a * mean_b
    # of both variances only the sum is needed
    variances = _smoothed(a * a + b * b, taps) - square_a - square_b
    covariance = _smoothed(a * b, taps) - product
    similar: Image = ((2 * product + C1) * (2 * covariance + C2)) / ((square_a + square_b + C1) * (variances + C2))
    return similar


def _taps(length: int) -> NDArray[np.float64]:
    """(length,) a Gaussian around the middle, which sums to 1."""
    away = np.arange(length) - (length - 1) / 2
    taps = np.exp(-away * away / (2 * SIGMA * SIGMA))
    return taps / taps.sum()


def _smoothed(image: Image, taps: list[NDArray[np.float64]]) -> Image:
    """(H - taps + 1, W - taps + 1, C): each axis by itself, where all taps are inside."""
    for axis, weights in enumerate(taps):
        length = image.shape[axis] - len(weights) + 1
        shifted = [image[at : at + length] if axis == 0 else image[:, at : at + length] for at in range(len(weights))]
        image = shifted[0] * weights[0]
        for part, weight in zip(shifted[1:], weights[1:], strict=True):
            image += part * weight
    return image


def _squared_error(a: Image, b: Image) -> NDArray[np.float64]:
    """(H, W, C) float64."""
    error = np.subtract(a, b, dtype=np.float64)
    error *= error
    return error
