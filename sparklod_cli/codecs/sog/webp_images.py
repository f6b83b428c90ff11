"""Images with a texel per splat as lossless WebP, which Pillow decodes when their sides are known to be in bounds."""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.WebPImagePlugin import WebPImageFile

from ...support.errors import FormatError
from ...support.untrusted import quoted_value

Texels = NDArray[np.uint8]

#: Effort of the encoder: quality tells how long it searches for repetitions, the method how many ways of coding it
#: tries. Measured: with more, files get smaller by less than 0.3 % and take up to ten times as long.
QUALITY, METHOD = 50, 1

#: Longest side of a WebP image, in texels.
MAX_SIDE = 16_383

#: Sides of images are multiples of this, as PlayCanvas makes them.
STEP = 4

#: (N,) A R G B from the most significant byte.
Pixels = NDArray[np.uint32]

#: Reads the next `size` bytes, or fewer, of which none are left at the end.
Read = Callable[[int], bytes]

#: Bytes that are read at a time.
PIECE = 1 << 20

#: Bytes that are read of any file at first: the headers of the file and of its first chunk, and what tells its sides.
START = 30

#: Flag of a WebP file's extended header.
ANIMATED = 2


@dataclass(frozen=True)
class WebPHeader:
    """First bytes of a WebP file, `start`, and the width and height in pixels in them."""

    start: bytes
    width: int
    height: int


def read_header(read: Read, name: str) -> WebPHeader:
    """Read the header of a file: its first chunk, of one of three kinds.

    Raises:
        FormatError: it is no still WebP image.
    """
    data = read(START)
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) == START else b""
    if kind == b"VP8X":  # 24 bits each, minus one
        if data[20] & ANIMATED:
            raise FormatError(f"{quoted_value(name)} is an animation, but SOG needs a still image")
        sides = int.from_bytes(data[24:27], "little"), int.from_bytes(data[27:30], "little")
        return WebPHeader(data, 1 + sides[0], 1 + sides[1])
    if kind == b"VP8L":  # 14 bits each, minus one, after a byte of signature
        bits = int.from_bytes(data[21:25], "little")
        return WebPHeader(data, 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF))
    if kind == b"VP8 ":  # 14 bits each, after a frame tag and a start code
        width, height = struct.unpack_from("<HH", data, 26)
        return WebPHeader(data, width & 0x3FFF, height & 0x3FFF)
    raise FormatError(f"{quoted_value(name)} is not a WebP image")


def pixels_of(header: WebPHeader, read: Read, name: str) -> Pixels:
    """Return (width * height,) pixels, row by row, of a file whose sides are known to be in bounds.

    libwebp asks for memory by them; `read` gives what comes after the header.

    Raises:
        FormatError: libwebp refuses the file, or its image is not complete.
    """
    data = header.start + b"".join(iter(lambda: read(PIECE), b""))
    try:
        # Not by Image.open, which warns of large images and refuses larger ones.
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = image if image.mode == "RGBA" else image.convert("RGBA")
            return np.frombuffer(texels.tobytes("raw", "BGRA"), "<u4")
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FormatError(f"{quoted_value(name)} is a corrupt WebP image: {error}") from None


def size_for(count: int) -> tuple[int, int]:
    """Return width and height of the image that holds so many splats: about a square."""
    width = STEP * math.ceil(math.sqrt(count) / STEP)
    return width, STEP * math.ceil(count / width / STEP)


def image_of(texels: Texels, width: int, height: int) -> Texels:
    """Arrange (N, C) texels row by row as (height, width, C), with zeros behind them."""
    image = np.zeros((height * width, texels.shape[1]), np.uint8)
    image[: len(texels)] = texels
    return image.reshape(height, width, -1)


def encode_webp(image: Texels) -> bytes:
    """Encode a file of (height, width, 3 or 4) texels, in which colours of alpha 0 stay what they are."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, exact=True, quality=QUALITY, method=METHOD)
    return file.getvalue()
