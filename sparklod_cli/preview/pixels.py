"""From images of floats to pixels of 8 bits, and to the bytes of picture files."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw

from ..render.colors import Coloring
from ..render.labels import BACKGROUND, write_scale
from ..render.rasterizer import Image

#: (H, W, 3) or, with alpha that red, green and blue are not multiplied by, (H, W, 4).
Pixels = NDArray[np.uint8]

#: Red, green and blue, 0..1.
Color = tuple[float, float, float]

#: Deflate level of PNG: the next ones take twice as long for a few percent.
PNG_LEVEL = 4

#: Height of a picture whose scale is drawn in its own size; the least size, and the least picture that has a scale.
WHOLE_HEIGHT, LEAST_UNIT, LEAST_PICTURE = 1000, 0.62, (400, 240)

#: How much is seen of what is behind a scale.
BEHIND = 0.25


def over(image: Image, background: Color | None) -> Image:
    """An image before a background: (H, W, 4) with alpha 1; as it is where that is None."""
    if background is None:
        return image
    through = 1 - image[..., 3:]
    rgb = image[..., :3] + through * np.asarray(background, np.float32)
    return np.concatenate([rgb, np.ones_like(through)], axis=2)


def eight_bits(image: Image) -> Pixels:
    """(H, W, 4) of an image, colours divided by alpha; (H, W, 3) where alpha is 1 everywhere."""
    alpha = image[..., 3:]
    if (alpha == 1).all():
        return _codes(image[..., :3])
    with np.errstate(divide="ignore", invalid="ignore"):
        straight = np.where(alpha > 0, image[..., :3] / alpha, 0)
    return np.concatenate([_codes(straight), _codes(alpha)], axis=2)


def _codes(values: Image) -> Pixels:
    codes: Pixels = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return codes


def difference(a: Image, b: Image, gain: float) -> Image:
    """(H, W, 4) how far two images of alpha 1 are apart in each channel, so many times."""
    apart = np.clip(gain * np.abs(np.clip(a[..., :3], 0, 1) - np.clip(b[..., :3], 0, 1)), 0, 1)
    return np.concatenate([apart, np.ones_like(a[..., 3:])], axis=2).astype(np.float32)


def with_scale(pixels: Pixels, bar: Coloring) -> Pixels:
    """A picture with what its colours mean, on its right; one that has no room for that stays as it is."""
    height, width = pixels.shape[:2]
    if width < LEAST_PICTURE[0] or height < LEAST_PICTURE[1]:
        return pixels
    unit = max(LEAST_UNIT, min(height / WHOLE_HEIGHT, width / (1.6 * WHOLE_HEIGHT)))
    left, top, bottom = round(width - 190 * unit), round(0.26 * height - 60 * unit), round(0.84 * height + 24 * unit)
    pixels = pixels.copy()
    panel = pixels[max(0, top) : bottom, max(0, left) :]
    ground = np.array([*bytes.fromhex(BACKGROUND[1:]), 255][: pixels.shape[2]])
    panel[...] = np.rint(BEHIND * panel + (1 - BEHIND) * ground).astype(np.uint8)
    picture = Pillow.fromarray(pixels)
    write_scale(picture, ImageDraw.Draw(picture), unit, bar)
    return np.asarray(picture)


def encode(pixels: Pixels, form: str) -> bytes:
    """The bytes of a "png" or, without loss, of a "webp"."""
    out = io.BytesIO()
    picture = Pillow.fromarray(pixels)
    if form == "webp":
        picture.save(out, "WEBP", lossless=True, exact=True, method=2)
    else:
        picture.save(out, "PNG", compress_level=PNG_LEVEL)
    return out.getvalue()


def encode_floats(values: NDArray[np.float32]) -> bytes:
    """The bytes of a .npy file."""
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()
