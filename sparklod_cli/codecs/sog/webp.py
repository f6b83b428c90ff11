"""WebP images of a SOG: headers, pixels, and lossless writing."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.WebPImagePlugin import WebPImageFile

from ...system.errors import FormatError
from ...system.untrusted import quoted_value
from ..zip_folder import PIECE

Texels = NDArray[np.uint8]

#: Effort of the encoder: quality tells how long it searches for repetitions, the method how many ways of coding it
#: tries. Measured: with more, files get smaller by less than 0.3 % and take up to ten times as long.
QUALITY, METHOD = 50, 1

#: Longest side of a WebP image, in texels.
MAX_SIDE = 16_383

#: (N,) A R G B from the most significant byte.
Pixels = NDArray[np.uint32]

#: Reads the next `size` bytes, or fewer, of which none are left at the end.
Read = Callable[[int], bytes]

#: Bytes that are read of any file at first: the headers of the file and of its first chunk, and what tells its sides.
START = 30

#: Most chunks that are read before that of the pixels: a colour profile, alpha, and some that are unknown.
MOST_BEFORE = 16

#: Flag of a WebP file's extended header.
ANIMATED = 2


class WebPHeader(NamedTuple):
    """First bytes of a WebP file, `start`, and what they say of its pixels."""

    start: bytes
    width: int
    height: int
    lossy: bool


def read_header(read: Read, name: str) -> WebPHeader:
    """Read the header of a still WebP image: its first chunk; in an extended file, all chunks up to the pixels."""
    data = read(START)
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) == START else b""
    if kind == b"VP8X":  # 24 bits each, minus one
        if data[20] & ANIMATED:
            raise FormatError(f"{quoted_value(name)} is an animation, but SOG needs a still image")
        sides = int.from_bytes(data[24:27], "little"), int.from_bytes(data[27:30], "little")
        data, lossy = _up_to_pixels(data, read)
        return WebPHeader(data, 1 + sides[0], 1 + sides[1], lossy)
    if kind == b"VP8L":  # 14 bits each, minus one, after a byte of signature
        bits = int.from_bytes(data[21:25], "little")
        return WebPHeader(data, 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), False)
    if kind == b"VP8 ":  # 14 bits each, after a frame tag and a start code
        width, height = struct.unpack_from("<HH", data, 26)
        return WebPHeader(data, width & 0x3FFF, height & 0x3FFF, True)
    raise FormatError(f"{quoted_value(name)} is not a WebP image")


def _up_to_pixels(data: bytes, read: Read) -> tuple[bytes, bool]:
    """Read the chunks up to the pixels; return all bytes so far, and whether the pixels are lossy."""
    for _ in range(MOST_BEFORE):
        head = read(8)
        data += head
        if len(head) < 8 or head[:4] in (b"VP8L", b"VP8 "):
            return data, head[:4] == b"VP8 "
        size = int.from_bytes(head[4:], "little")
        data += read(size + size % 2)
    return data, False


def pixels_of(header: WebPHeader, read: Read, name: str) -> Pixels:
    """Return (width * height,) pixels, row by row, of a file whose sides are in bounds: libwebp allocates them.

    `read` returns the bytes after the header.
    """
    data = header.start + b"".join(iter(lambda: read(PIECE), b""))
    try:
        # Not by Image.open, which warns of large images and refuses larger ones.
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = image if image.mode == "RGBA" else image.convert("RGBA")
            return np.frombuffer(texels.tobytes("raw", "BGRA"), "<u4")
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FormatError(f"{quoted_value(name)} is a corrupt WebP image: {error}") from None


def encode_webp(image: Texels) -> bytes:
    """Encode a file of (height, width, 3 or 4) texels, which keeps colours of alpha 0."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, exact=True, quality=QUALITY, method=METHOD)
    return file.getvalue()
