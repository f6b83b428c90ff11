"""WebP images, which libwebp decodes by way of Pillow when their sides are known to be in bounds."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL.WebPImagePlugin import WebPImageFile

from ...support.errors import FormatError
from ...support.untrusted import quoted_value

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
    """What the first bytes of a file say.

    Attributes:
        start: these bytes.
        width, height: in pixels.
    """

    start: bytes
    width: int
    height: int


def read_header(read: Read, name: str) -> WebPHeader:
    """Reads the header of a file: its first chunk, of one of three kinds.

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
    """Return (width * height,) pixels, row by row.

    Args:
        header: of `read_header`, whose sides are known to be in bounds: libwebp asks for memory by them.
        read: what comes after it.
        name: of the file, for messages.

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
