"""Differences of two images: PSNR, that of edges alone, SSIM, the tile that differs most, and popping."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.errors import SparklodError

#: (H, W, C), 0..1.
Image = NDArray[np.floating[Any]]

#: (H, W): True for each pixel that counts.
Mask = NDArray[np.bool_]

#: Gray backgrounds on which pictures are compared, by name.
BACKGROUNDS = {"black": 0.0, "white": 1.0}

#: Largest PSNR in dB. Identical images have it instead of infinity, because tables, means and assertions need a number;
#: an image rounded to 8 bits has 59 dB.
MOST_PSNR = 100.0

#: Side of a tile, pixels.
TILE = 64

#: SSIM as defined by Wang, Bovik, Sheikh and Simoncelli in 2004: standard deviation and width in pixels of its Gaussian
#: window, and the constants that stabilize the division in dark and flat regions of images of 0..1.
SIGMA, WINDOW, C1, C2 = 1.5, 11, 0.01**2, 0.03**2

#: Weights of red, green and blue in luminance, from Rec. 709.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)

#: Weights of Scharr's operator, a difference along one axis smoothed along the other; its length hardly depends on the
#: direction. Normalized: a ramp that rises by g per pixel has the gradient g.
SCHARR = (3 / 32, 10 / 32, 3 / 32)

#: Least gradient of an edge, luminance per pixel. The operator sees half of the height of a step on each side, so steps
#: of a fifth of the range from black to white are edges; shades and soft textures are not.
EDGE = 0.1

#: Rows that are smoothed at a time, few enough for the processor's cache.
STRIP = 32


@dataclass(frozen=True)
class Tile:
    """Position of a tile's upper left pixel, and its PSNR in dB."""

    psnr: float
    x: int
    y: int


def check_covered(reference: Image, subject: str) -> None:
    """Raise a `SparklodError` if a reference, (H, W, 4), is empty, which would make a comparison meaningless.

    `subject` names the reference in the error.
    """
    if not (reference[..., 3] > 0).any():
        raise SparklodError(
            f"{subject} covers no pixel, so there is nothing to compare with; check --near and --far, and that cameras"
            " and scene share their axes (--camera-axes, --world-transform, --up)"
        )


def on_background(image: Image, gray: float) -> Image:
    """Composite an image with premultiplied alpha over a gray background 0..1; return (H, W, 3), clipped to 0..1."""
    return np.clip(image[..., :3] + np.float32(gray) * (1 - image[..., 3:]), 0, 1)


def psnr_of(mse: float) -> float:
    """Return the PSNR in dB for a mean square error of images of 0..1; at most `MOST_PSNR`."""
    return min(-10 * math.log10(mse), MOST_PSNR) if mse > 0 else MOST_PSNR


def psnr(a: Image, b: Image) -> float:
    """Return the peak signal-to-noise ratio in dB over all pixels and channels of two images; at most `MOST_PSNR`."""
    return psnr_of(float(np.mean(_squared_error(a, b))))


def edges(image: Image) -> Mask:
    """Find the edges of a picture, (H, W, 4) with premultiplied alpha, on each of `BACKGROUNDS`.

    An edge is a pixel whose luminance has a gradient of at least `EDGE`; its eight neighbours count, too.
    """
    strong = np.zeros(np.add(image.shape[:2], 2), bool)
    for gray in BACKGROUNDS.values():
        luminance = on_background(image, gray).astype(np.float32, copy=False) @ LUMINANCE
        strong[1:-1, 1:-1] |= _gradient(luminance) >= EDGE
    rows = strong[:-2] | strong[1:-1] | strong[2:]
    wide: Mask = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return wide


def edge_psnr(a: Image, b: Image, where: Mask) -> float | None:
    """Return the PSNR in dB over the pixels of a mask, at most `MOST_PSNR`; None if the mask is empty."""
    return psnr(a[where], b[where]) if where.any() else None


def popping(a: Image, b: Image, a_before: Image, b_before: Image) -> float:
    """Return the root mean square change of a picture's error between two frames, in steps of 8 bits.

    The error of a frame is `a - b`, with `b` as the reference.
    """
    change = np.subtract(a, b, dtype=np.float64)
    change -= a_before
    change += b_before
    return 255 * math.sqrt(float(np.mean(change * change)))


def worst_tile(a: Image, b: Image) -> Tile:
    """Return the tile with the lowest PSNR, the first of equals. Tiles at the right and lower edge may be smaller."""
    error = _squared_error(a, b).mean(axis=2)
    height, width = error.shape
    down, across = np.arange(0, height, TILE), np.arange(0, width, TILE)
    sums = np.add.reduceat(np.add.reduceat(error, down, axis=0), across, axis=1)
    pixels = np.minimum(height - down, TILE)[:, None] * np.minimum(width - across, TILE)
    mean = sums / pixels
    row, column = divmod(int(np.argmax(mean)), len(across))
    return Tile(psnr_of(float(mean[row, column])), column * TILE, row * TILE)


def ssim(a: Image, b: Image) -> float:
    """Return the structural similarity (Wang et al. 2004), 1 for identical images, averaged over pixels and channels.

    The window slides inside the image only; it is cut to the side of a smaller image.
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
    """Return the SSIM at each position of the window inside the image."""
    mean_a, mean_b = _smoothed(a, taps), _smoothed(b, taps)
    square_a, square_b, product = mean_a * mean_a, mean_b * mean_b, mean_a * mean_b
    # Only the sum of both variances is needed.
    variances = _smoothed(a * a + b * b, taps) - square_a - square_b
    covariance = _smoothed(a * b, taps) - product
    similar: Image = ((2 * product + C1) * (2 * covariance + C2)) / ((square_a + square_b + C1) * (variances + C2))
    return similar


def _taps(length: int) -> NDArray[np.float64]:
    """Return (length,) weights of a Gaussian window with sum 1."""
    away = np.arange(length) - (length - 1) / 2
    taps = np.exp(-away * away / (2 * SIGMA * SIGMA))
    return taps / taps.sum()


def _smoothed(image: Image, taps: list[NDArray[np.float64]]) -> Image:
    """Convolve an image along each axis, where the window is inside; return (H - taps + 1, W - taps + 1, C)."""
    for axis, weights in enumerate(taps):
        length = image.shape[axis] - len(weights) + 1
        shifted = [image[at : at + length] if axis == 0 else image[:, at : at + length] for at in range(len(weights))]
        image = shifted[0] * weights[0]
        for part, weight in zip(shifted[1:], weights[1:], strict=True):
            image += part * weight
    return image


def _gradient(luminance: Image) -> Image:
    """Return (H, W) lengths of the gradient per pixel; the border of the picture is repeated outwards."""
    padded = np.pad(luminance, 1, mode="edge")
    first, middle, last = SCHARR
    down = first * padded[:, :-2] + middle * padded[:, 1:-1] + last * padded[:, 2:]
    across = first * padded[:-2] + middle * padded[1:-1] + last * padded[2:]
    length: Image = np.hypot(down[2:] - down[:-2], across[:, 2:] - across[:, :-2])
    return length


def _squared_error(a: Image, b: Image) -> NDArray[np.float64]:
    error = np.subtract(a, b, dtype=np.float64)
    error *= error
    return error
