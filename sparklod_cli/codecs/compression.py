"""Compressed bytes: one parallel gzip member out, bounded inflating in.

Why not the library's own threaded gzip: see docs/decisions.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from ..support.errors import ChecksumError, FormatError, PromiseError, TooLongError, TruncatedError
from ..support.parallel import ordered_map
from ..support.progress import Progress

BLOCK = 1 << 18  # bytes that are deflated apart
WINDOW = 1 << 15  # bytes before a block that it may refer to
PIECE = 1 << 17  # bytes that are read at a time

#: Up to this size a header's promise is not doubted; beyond, a file may expand by at most MAX_RATIO. Real scenes reach
#: a ratio of 3, a scene of equal splats 1000, which is also deflate's limit.
TRUSTED_SIZE, MAX_RATIO = 1 << 26, 200

_ZlibError: Any = zlib_ng.error  # the stubs take the class for an instance
GZIP_MAGIC = b"\x1f\x8b"
_RAW, _GZIP = -zlib_ng.MAX_WBITS, zlib_ng.MAX_WBITS + 16


def gzip_member(data: NDArray[np.uint8], level: int, threads: int, progress: Progress) -> Iterator[bytes]:
    """One gzip member of `data`, piece by piece; the same bytes for any number of threads.

    As pigz does: blocks are deflated apart, each with the end of the one before as its dictionary, and end on a byte
    boundary by an empty stored block, so that they join to one deflate stream.
    """
    view = data.data.cast("B")
    starts = list(range(0, len(view), BLOCK)) or [0]

    def deflate(start: int) -> bytes:
        end = start + BLOCK
        finish = zlib_ng.Z_FINISH if end >= len(view) else zlib_ng.Z_SYNC_FLUSH
        window = view[max(0, start - WINDOW) : start]
        memory, strategy = zlib_ng.DEF_MEM_LEVEL, zlib_ng.Z_DEFAULT_STRATEGY
        packer = zlib_ng.compressobj(level, zlib_ng.DEFLATED, _RAW, memory, strategy, zdict=window)
        return packer.compress(view[start:end]) + packer.flush(finish)

    yield b"\x1f\x8b\x08\0\0\0\0\0\0\xff"  # no name, no time, no system: the same scene gives the same bytes
    for start, block in zip(starts, ordered_map(deflate, starts, threads), strict=True):
        yield block
        progress("writing", min(start + BLOCK, len(view)), len(view), "B")
    yield struct.pack("<II", zlib_ng.crc32(view), len(view) & 0xFFFFFFFF)


def check_promise(total: int, file_size: int) -> None:
    """Raises `FormatError` where a header promises more bytes than the file can honestly expand to."""
    if total > TRUSTED_SIZE and total > MAX_RATIO * file_size:
        raise PromiseError(f"its header promises {total:,} bytes, {file_size:,} bytes of file cannot hold that")


class Inflate:
    """Reads a gzip member from a file without ever holding much more than was asked for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._rest = b""
        self._unpacker = zlib_ng.decompressobj(_GZIP)

    def read(self, size: int) -> bytes:
        """The next `size` bytes, or fewer where the data ends.

        Raises:
            FormatError: the data is corrupt.
        """
        pieces = []
        while size > 0 and not self._unpacker.eof:
            packed = self._rest or self._file.read(PIECE)
            try:
                piece: bytes = self._unpacker.decompress(packed, size)
            except _ZlibError as error:
                kind = ChecksumError if "check" in str(error) else FormatError  # "incorrect data check"
                raise kind(f"corrupt gzip data: {error}") from None
            self._rest = self._unpacker.unconsumed_tail
            if not (packed or piece):
                break
            pieces.append(piece)
            size -= len(piece)
        return b"".join(pieces)

    def finish(self, *, allow_more: bool) -> None:
        """Checks that the member ends here and that its checksum holds.

        Args:
            allow_more: bytes may follow in it that are of no interest; then nothing is checked.

        Raises:
            FormatError: it does not.
        """
        if allow_more:
            return
        if self.read(1):
            raise TooLongError("more data than its header promises")
        if not self._unpacker.eof:
            raise TruncatedError("cut short: the gzip checksum is missing")

    def behind(self) -> bytes:
        """The first bytes that follow the member in the file, two where there are so many; empty before its end."""
        if not self._unpacker.eof:
            return b""
        rest: bytes = self._unpacker.unused_data
        at = self._file.tell()
        more = self._file.read(2)
        self._file.seek(at)
        return (rest + more)[:2]

    def end(self) -> int:
        """Where the member ends in the file, once it has been read."""
        return self._file.tell() - len(self._unpacker.unused_data)


class _Window:
    """The next `size` bytes of a file, as a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int) -> bytes:
        data = self._file.read(min(size, self._left))
        self._left -= len(data)
        return data


class Unzstd:
    """Reads the zstd frame that the next `packed` bytes of a file are, without holding more than was asked for."""

    def __init__(self, file: BinaryIO, packed: int, name: str) -> None:
        self._name = name
        window: Any = _Window(file, packed)
        self._reader = zstandard.ZstdDecompressor().stream_reader(window, read_size=PIECE)

    def read(self, size: int) -> bytes:
        """The next `size` bytes, or fewer where the data ends.

        Raises:
            FormatError: the data is corrupt; names the stream.
        """
        try:
            piece: bytes = self._reader.read(size)
        except zstandard.ZstdError as error:
            kind = ChecksumError if "checksum" in str(error) else FormatError
            raise kind(f"corrupt zstd data in stream {self._name}: {error}") from None
        return piece

    def finish(self) -> None:
        """Raises `FormatError` unless the stream ends here."""
        if self.read(1):
            raise TooLongError(f"stream {self._name} is longer than its table says")
