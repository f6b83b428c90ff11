"""WebP images as bands of pixels: lossless ones as they are read, all others by Pillow, whole."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from PIL.WebPImagePlugin import WebPImageFile

from ...support.errors import FormatError
from ...support.untrusted import quoted_value
from .lossless import PIECE, ImageError, LosslessImage, Pixels, Read

#: Bytes of the header of a file and of its first chunk, and those that are read of any file at first.
HEADER, START = 20, 30

#: Flag of a WebP file's extended header.
ANIMATED = 2


@dataclass(frozen=True)
class WebPHeader:
    """What the first bytes of a file say.

    Attributes:
        start: these bytes.
        kind: of its first chunk.
        width, height: in pixels.
    """

    start: bytes
    kind: bytes
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
        return WebPHeader(data, kind, 1 + sides[0], 1 + sides[1])
    if kind == b"VP8L":  # 14 bits each, minus one, after a byte of signature
        bits = int.from_bytes(data[21:25], "little")
        return WebPHeader(data, kind, 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF))
    if kind == b"VP8 ":  # 14 bits each, after a frame tag and a start code
        width, height = struct.unpack_from("<HH", data, 26)
        return WebPHeader(data, kind, width & 0x3FFF, height & 0x3FFF)
    raise FormatError(f"{quoted_value(name)} is not a WebP image")


def bands(header: WebPHeader, read: Read, name: str) -> Iterator[Pixels]:
    """All pixels of an image, some rows at a time; each band until the next.

    Args:
        header: of `read_header`.
        read: what comes after it.
        name: of the file, for messages.

    Raises:
        FormatError: the image is corrupt.
    """
    try:
        if header.kind == b"VP8L":
            yield from _lossless(header, read)
        else:
            yield _by_pillow(header.start + b"".join(iter(lambda: read(PIECE), b"")))
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise FormatError(f"{quoted_value(name)} is a corrupt WebP image: {error}") from None


def _lossless(header: WebPHeader, read: Read) -> Iterator[Pixels]:
    """The pixels of the first chunk; what is behind it in the file only has to be there."""
    size = int.from_bytes(header.start[4:8], "little") + 8 - HEADER
    chunk = int.from_bytes(header.start[16:20], "little")
    if chunk > size:
        raise ImageError("its chunk is larger than its file")
    ahead = header.start[HEADER:]
    taken = len(ahead)

    def of_chunk(wanted: int) -> bytes:
        nonlocal ahead, taken
        if ahead:
            data, ahead = ahead[:chunk], b""
            return data
        data = read(min(wanted, max(0, chunk - taken)))
        taken += len(data)
        return data

    yield from LosslessImage(of_chunk).bands()
    while taken < size:
        data = read(min(PIECE, size - taken))
        if not data:
            raise ImageError("its data end early")
        taken += len(data)


def _by_pillow(data: bytes) -> Pixels:
    # Not by Image.open, which warns of large images and refuses larger ones: the size has been checked above.
    with WebPImageFile(io.BytesIO(data)) as image:
        texels = np.asarray(image if image.mode == "RGBA" else image.convert("RGBA"))
    return np.ascontiguousarray(texels[:, :, [2, 1, 0, 3]]).view("<u4").ravel()
