"""Images of a texel per splat, as lossless WebP."""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Texels = NDArray[np.uint8]

#: Effort of the encoder: quality tells how long it searches for repetitions, the method how many ways of coding it
#: tries. Measured: with more, files get smaller by less than 0.3 % and take up to ten times as long.
QUALITY, METHOD = 50, 1

#: Longest side of a WebP image, in texels.
MAX_SIDE = 16_383

#: Sides of images are multiples of this, as PlayCanvas makes them.
STEP = 4


def size_for(count: int) -> tuple[int, int]:
    """Width and height of the image that holds so many splats: about a square."""
    width = STEP * math.ceil(math.sqrt(count) / STEP)
    return width, STEP * math.ceil(count / width / STEP)


def image_of(texels: Texels, width: int, height: int) -> Texels:
    """(N, C) texels row by row as (height, width, C), with zeros behind them."""
    image = np.zeros((height * width, texels.shape[1]), np.uint8)
    image[: len(texels)] = texels
    return image.reshape(height, width, -1)


def encode_webp(image: Texels) -> bytes:
    """A file of (height, width, 3 or 4) texels, in which colours of alpha 0 stay what they are."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, exact=True, quality=QUALITY, method=METHOD)
    return file.getvalue()
