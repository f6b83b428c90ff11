"""Reads lossless WebP (RFC 9649) in bands of rows: whatever the size of an image, few of its pixels are in memory.

libwebp, which Pillow has, keeps all pixels of an image, several times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..kernels import webp_codes, webp_pixels, webp_transforms
from ..kernels.webp_transforms import Transform

Pixels = NDArray[np.uint32]

#: Reads the next `size` bytes, or fewer, of which none are left at the end.
Read = Callable[[int], bytes]

#: First byte of an image.
SIGNATURE = 0x2F

#: Bytes that are read at a time, and bytes of the input that a kernel may read without asking: the codes of a group, of
#: 3,136 symbols with at most 14 bits each, are less.
PIECE, MARGIN = 1 << 17, 1 << 13

#: Pixels of a band: few enough to stay in the processor's cache.
BAND = 1 << 14

#: How far back a copy may reach, and how many pixels it may have.
REACH, LONGEST = 1 << 20, 1 << 12

#: Most bits of a table of codes, if there are at most so many groups of codes: larger tables are faster, but take the
#: more memory.
MOST_BITS = ((1 << 10, 11), (1 << 12, 9), (1 << 16, 7))


class ImageError(ValueError):
    """An image is corrupt."""


def parts(size: int, shift: int) -> int:
    """Tiles along so many pixels."""
    return (size + (1 << shift) - 1) >> shift


class Bits:
    """The bits of an image, a piece of which is in memory as 64-bit words.

    Attributes:
        words: (W,) uint64, zeros behind the end.
        at: (3,) uint64, of which the first is the position in the words, in bits.
        limit: the position up to which kernels may begin with something.
    """

    def __init__(self, read: Read) -> None:
        self._read, self._ended = read, False
        self.words = np.zeros((PIECE + 2 * MARGIN) // 8, np.uint64)
        self.at = np.zeros(3, np.uint64)
        self._bytes = 0  # in the words
        self.limit = -1
        self.more()

    def more(self) -> None:
        """Reads on.

        Raises:
            ImageError: the data have ended.
        """
        if self._ended:
            raise ImageError("its data end early")
        here = self.words.view(np.uint8)
        gone = int(self.at[0]) // 64 * 8
        kept = self._bytes - gone
        here[:kept] = here[gone : self._bytes].copy()
        self.at[0] -= np.uint64(8 * gone)
        wanted = len(here) - MARGIN - kept
        while wanted and not self._ended:
            data = self._read(wanted)
            self._ended = not data
            here[kept : kept + len(data)] = np.frombuffer(data, np.uint8)
            kept += len(data)
            wanted -= len(data)
        here[kept:] = 0
        self._bytes = kept
        self.limit = 8 * (kept if self._ended else kept - MARGIN)

    def number(self, bits: int) -> int:
        """The next bits as a number, least significant first."""
        while int(self.at[0]) > self.limit:
            self.more()
        bit = int(self.at[0])
        word, shift = divmod(bit, 64)
        both = int(self.words[word]) | int(self.words[word + 1]) << 64
        self.at[0] = np.uint64(bit + bits)
        return both >> shift & ((1 << bits) - 1)

    def check(self) -> None:
        """Raises `ImageError` where more has been taken than there is."""
        if self._ended and int(self.at[0]) > self.limit:
            raise ImageError("its data end early")


class Coded:
    """The pixels of an image as they are coded, some of which are in memory.

    Args:
        bits: where its codes begin.
        width, height: of the image.
        tiled: its tiles may have codes of their own; only in the image itself, not in those that its transforms need.
    """

    def __init__(self, bits: Bits, width: int, height: int, *, tiled: bool = False) -> None:
        self._bits = bits
        cached = bits.number(4) if bits.number(1) else 0
        if cached > 11:
            raise ImageError(f"its cache has 2 ** {cached} colours, more than 2 ** 11")
        tiles, across, shift = np.zeros(1, np.uint16), 1, 0
        if tiled and bits.number(1):
            shift = 2 + bits.number(3)
            across = parts(width, shift)
            image = Coded(bits, across, parts(height, shift)).all()
            tiles = (image >> np.uint32(8)).astype(np.uint16)
        tables = _read_codes(bits, int(tiles.max()) + 1, 1 << cached if cached else 0)
        cache = np.zeros(1 << cached, np.uint32)
        self._codes = webp_pixels.Codes(*tables[:3], tiles, across, shift, cache, 32 - cached, width, width * height)
        # An image that a transform needs is kept whole; it has a pixel for each tile of 16 pixels or more.
        kept = min(self._codes.total, 2 * REACH) if tiled else self._codes.total
        self._pixels = np.empty(kept + LONGEST, np.uint32)
        self._first = 0
        self._at = np.zeros(3, np.uint64)

    def pixels(self, begin: int, stop: int) -> Pixels:
        """Pixels of the next rows, until the next call.

        Raises:
            ImageError: they are corrupt.
        """
        if stop + LONGEST - self._first > len(self._pixels):
            gone = begin - REACH - self._first
            ahead = int(self._at[1]) - self._first
            self._pixels[: ahead - gone] = self._pixels[gone:ahead].copy()
            self._first += gone
        while int(self._at[1]) < stop:
            self._at[0] = self._bits.at[0]
            words, limit = self._bits.words, self._bits.limit
            answer = webp_pixels.read_pixels(words, self._at, limit, self._codes, self._pixels, self._first, stop)
            if answer == webp_codes.CORRUPT:
                raise ImageError("a copy leads beyond its pixels")
            self._bits.at[0] = self._at[0]
            if answer == webp_codes.INPUT:
                self._bits.more()
        self._bits.check()
        return self._pixels[begin - self._first : stop - self._first]

    def all(self) -> Pixels:
        """All pixels."""
        return self.pixels(0, self._codes.total)


def _read_codes(bits: Bits, groups: int, cache: int) -> webp_codes.Tables:
    """So many groups of codes, where the cache has so many colours."""
    most = next(most for many, most in MOST_BITS if groups <= many)
    found = np.zeros((groups, webp_codes.COLUMNS), np.uint32)
    tables = webp_codes.Tables(found, np.zeros(1 << 14, np.uint16), np.zeros(1 << 13, np.int32), np.zeros(2, np.int64))
    answer, done = webp_codes.INPUT, 0
    while answer != webp_codes.DONE:
        answer, done = webp_codes.read_codes(bits.words, bits.at, bits.limit, tables, done, cache, most)
        if answer == webp_codes.CORRUPT:
            raise ImageError("a code of its colours is incomplete")
        if answer == webp_codes.INPUT:
            bits.more()
        elif answer == webp_codes.ROOM:
            table, longs = (np.concatenate([each, np.zeros_like(each)]) for each in (tables.table, tables.longs))
            tables = tables._replace(table=table, longs=longs)
        bits.check()
    return tables


def _transform(bits: Bits, kind: int, width: int, height: int) -> Transform:
    """A transform of an image of these sides, whose data come next."""
    none = np.zeros(0, np.uint32)
    if kind in (webp_transforms.GREEN, webp_transforms.OPAQUE):
        return Transform(kind, width, none, 0, 0, none)
    if kind == webp_transforms.INDEXING:
        many = bits.number(8) + 1
        shift = 0 if many > 16 else 1 if many > 4 else 2 if many > 2 else 3
        steps = Coded(bits, many, 1).all().view(np.uint8).reshape(-1, 4)
        colors = np.zeros((256, 4), np.uint8)
        colors[:many] = np.cumsum(steps, axis=0, dtype=np.uint8)  # each is the difference to the one before
        return Transform(kind, width, colors.view(np.uint32).ravel(), 0, shift, none)
    shift = 2 + bits.number(3)
    across = parts(width, shift)
    tiles = Coded(bits, across, parts(height, shift)).all()
    return Transform(kind, width, tiles, across, shift, np.zeros(width, np.uint32))


class LosslessImage:
    """An image whose header has been read; its rows are read once.

    Args:
        read: of its data, the content of a VP8L chunk.

    Attributes:
        width, height: in pixels.

    Raises:
        ImageError: the data are corrupt.
    """

    def __init__(self, read: Read) -> None:
        self._bits = bits = Bits(read)
        if bits.number(8) != SIGNATURE:
            raise ImageError("its signature is wrong")
        self.width, self.height = 1 + bits.number(14), 1 + bits.number(14)
        self._has_alpha = bool(bits.number(1))
        if bits.number(3):
            raise ImageError("its version is unknown")

    def bands(self) -> Iterator[Pixels]:
        """All pixels, some rows at a time, each until the next.

        Raises:
            ImageError: the data are corrupt.
        """
        bits, width = self._bits, self.width
        first = [] if self._has_alpha else [webp_transforms.OPAQUE]
        transforms = [_transform(bits, kind, width, self.height) for kind in first]
        while bits.number(1):
            kind = bits.number(2)
            if any(kind == each.kind for each in transforms):
                raise ImageError("it has a transform twice")
            transforms.append(_transform(bits, kind, width, self.height))
            if kind == webp_transforms.INDEXING:
                width = parts(width, transforms[-1].shift)
        coded = Coded(bits, width, self.height, tiled=True)
        rows = max(1, BAND // self.width)
        for row in range(0, self.height, rows):
            stop = min(row + rows, self.height)
            pixels = coded.pixels(row * width, stop * width)
            yield self._undone(pixels, transforms[::-1], width, row)

    def _undone(self, pixels: Pixels, transforms: list[Transform], width: int, row: int) -> Pixels:
        """Rows as they are before any transform; `transforms` is in the order in which they are undone."""
        rows = len(pixels) // width
        band = np.empty((1 + rows) * width, np.uint32)  # a row for the one above
        band[width:] = pixels
        for each in transforms:
            part = band if each.kind == webp_transforms.PREDICTOR else band[width:]
            if each.kind == webp_transforms.INDEXING:
                width = each.width
                band = np.empty((1 + rows) * width, np.uint32)
            webp_transforms.undo(each, part, row, band[width:])
        return band[width:]
