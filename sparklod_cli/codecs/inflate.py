"""Inflating: gzip members on several threads where their blocks allow it, without buffering more than a few blocks.

The one place that chooses the library: ISA-L (package isal) where it is installed, zlib-ng elsewhere. What they inflate
is the same; docs/decisions/05-spz.md has their speeds.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Generator, Iterator
from typing import Any, BinaryIO

from zlib_ng import zlib_ng

from ..support.errors import ChecksumError, FormatError, TooLongError, TruncatedError
from ..support.parallel import ordered_map

try:
    from isal import isal_zlib as _library
except ImportError:
    _library = zlib_ng

#: What unpackers raise on data that are no deflate stream.
ERRORS: tuple[Any, ...] = (zlib_ng.error, _library.error)  # the stubs take the classes for instances

GZIP_MAGIC = b"\x1f\x8b"
#: How a member of deflate begins that has no fields but the ten bytes of its head, and one with a comment behind these,
#: which ends with a zero byte (RFC 1952).
PLAIN_HEAD, COMMENTED_HEAD, _HEAD_SIZE = GZIP_MAGIC + b"\x08\0", GZIP_MAGIC + b"\x08\x10", 10
#: Bytes up to which a comment is read; sparklod's have some fifty.
MOST_COMMENT = 1 << 12
_TRAILER = struct.Struct("<II")  # CRC-32 and number of the bytes, modulo 2 ** 32

#: Bytes before a position that a deflate stream may refer to; bytes of a file that one thread reads at a time, and
#: inflates to at most; and bytes that are read at a time to be cut into parts.
_WINDOW, _PIECE, _STEP, _TO_CUT = 1 << 15, 1 << 17, 1 << 18, 1 << 20

#: The end of an empty stored block, with which writers end a block at the beginning of a byte (a flush of zlib).
FLUSHED = b"\0\0\xff\xff"
#: It, for a search in two thirds of the time of `bytes.find`.
_FLUSH = re.compile(re.escape(FLUSHED))
#: Least and most bytes of a file from one such end to another that a thread inflates by themselves, and the most bytes
#: that they may inflate to: blocks of `compression.BLOCK` bytes lie in between, unless they compress to nearly nothing.
_LEAST_PART, _MOST_PART, _MOST_INFLATED = 1 << 13, 1 << 20, 1 << 22
#: An empty last block: after a flush, and nowhere else, it ends the stream without another byte.
_END = b"\x03\0"


def raw_unpacker(before: bytes = b"") -> Any:
    """Return what inflates a bare deflate stream that may refer to the data before it; it raises `ERRORS`."""
    more = {"zdict": before} if before else {}
    return _library.decompressobj(-zlib_ng.MAX_WBITS, **more)


class Inflate:
    """Reader of a gzip member of a file.

    Blocks that refer to no data before them, as `compression.gzip_member` writes them, are inflated on several threads;
    all other data on one.

    Args:
        file: open for reading at the beginning of the member; nobody else may use it until the last read.
        threads: to inflate on, besides the one that reads.

    Attributes:
        comment: of the head of the member; empty where it has none, or other fields besides.
    """

    def __init__(self, file: BinaryIO, threads: int = 1) -> None:
        self._file = file
        self._start = file.tell()
        self._head_size, self.comment = self._read_head()
        self._pieces = self._all_pieces(threads)
        self._rest = memoryview(b"")
        self._end: int | None = None
        self._check, self._size = 0, 0

    def read(self, size: int) -> bytes | memoryview:
        """Return the next `size` bytes, or fewer where the data ends; raises `FormatError` where they are corrupt."""
        pieces = []
        while size > 0:
            if not self._rest:
                self._rest = memoryview(next(self._pieces, b""))
                if not self._rest:
                    break
            pieces.append(self._rest[:size])
            self._rest = self._rest[len(pieces[-1]) :]
            size -= len(pieces[-1])
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def finish(self, *, allow_more: bool) -> None:
        """Raise `FormatError` unless the member ends here with a correct checksum, or `allow_more` leaves the rest."""
        if allow_more:
            self.close()
            return
        if self.read(1):
            raise TooLongError("it holds more data than its header announces")
        if self._end is None:
            raise TruncatedError("cut short: the gzip checksum is missing")

    def close(self) -> None:
        """End the threads, where not all has been read."""
        self._pieces.close()

    def behind(self) -> bytes:
        """Return the first two bytes after the member, or fewer at the end of the file; none before its end."""
        if self._end is None:
            return b""
        self._file.seek(self._end)
        return self._file.read(2)

    def end(self) -> int:
        """Return the position of the end of the member in the file, once it has been read."""
        assert self._end is not None, "the member has not been read to its end"
        return self._end

    def _read_head(self) -> tuple[int, bytes]:
        """Read the head, and return its bytes, after which the file is left, and comment; 0 bytes of any other head."""
        head = self._file.read(_HEAD_SIZE)
        if len(head) == _HEAD_SIZE and head.startswith(PLAIN_HEAD):
            return _HEAD_SIZE, b""
        if len(head) < _HEAD_SIZE or not head.startswith(COMMENTED_HEAD):
            return 0, b""
        comment, end, _ = self._file.read(MOST_COMMENT).partition(b"\0")
        if not end:
            return 0, b""
        size = _HEAD_SIZE + len(comment) + 1
        self._file.seek(self._start + size)
        return size, comment

    def _all_pieces(self, threads: int) -> Generator[bytes, None, None]:
        """Yield the data in pieces, none of them empty."""
        start = self._start + self._head_size
        if not self._head_size:
            self._file.seek(start)
            yield from self._rest_of(zlib_ng.decompressobj(zlib_ng.MAX_WBITS + 16))  # which checks the checksum, too
            return
        window = b""
        if threads > 1:
            # glibc gives the memory of a large object back to the system at once, and each new one then waits for the
            # system to clear its memory, unless one as large has been freed before. That costs a sixth of the time.
            bytes(_MOST_INFLATED)
            parts = _parts(self._file, start)
            with contextlib.closing(ordered_map(_alone, parts, threads)) as inflated:
                for size, piece in inflated:
                    if piece is None:
                        break
                    start += size
                    self._count(piece)
                    window = piece[-_WINDOW:] if len(piece) >= _WINDOW else (window + piece)[-_WINDOW:]
                    yield piece
            self._file.seek(start)
        for piece in self._rest_of(raw_unpacker(window)):
            self._count(piece)
            yield piece
        if self._end is not None:
            self._check_trailer()

    def _count(self, piece: bytes) -> None:
        self._check, self._size = zlib_ng.crc32(piece, self._check), self._size + len(piece)

    def _rest_of(self, unpacker: Any) -> Iterator[bytes]:
        """Yield the data from the position of the file on, on one thread."""
        packed = b""
        while not unpacker.eof:
            packed = unpacker.unconsumed_tail or self._file.read(_PIECE)
            try:
                piece: bytes = unpacker.decompress(packed, _STEP)
            except ERRORS as error:
                wrong = "check" in str(error)  # "incorrect data check"
                raise (ChecksumError if wrong else FormatError)(
                    "corrupt gzip data" + (": its checksum is wrong" if wrong else "")
                ) from None
            if piece:
                yield piece
            elif not packed and not unpacker.eof:
                return
        self._end = self._file.tell() - len(unpacker.unused_data)

    def _check_trailer(self) -> None:
        """Check what follows a bare deflate stream in a gzip member."""
        end, self._end = self.end(), None
        self._file.seek(end)
        trailer = self._file.read(_TRAILER.size)
        if len(trailer) < _TRAILER.size:
            return
        if _TRAILER.unpack(trailer) != (self._check, self._size & 0xFFFFFFFF):
            raise ChecksumError("corrupt gzip data: its checksum is wrong")
        self._end = end + _TRAILER.size


def _parts(file: BinaryIO, start: int) -> Iterator[memoryview]:
    """Cut the bytes of a file where a flush seems to end, as far as the parts are neither too long.

    The last flush is the end of the last part. Any four bytes may look like the end of a flush, so that a part need not
    be one; the bits before those are 0.
    """
    file.seek(start)
    data, at = b"", 0  # from the beginning of a part on, and where to look on in it
    while True:
        more = file.read(_TO_CUT)
        data += more
        begin = 0  # of the part
        while found := _FLUSH.search(data, max(at, begin + _LEAST_PART)):
            at = found.end()
            if data[found.start() - 1] < 1 << 5:
                yield memoryview(data)[begin:at]
                begin = at
        at = max(at, len(data) - len(FLUSHED) + 1) - begin
        data = data[begin:]
        if not more or len(data) > _MOST_PART:
            return


def _alone(part: memoryview) -> tuple[int, bytes | None]:
    """Inflate a part of a deflate stream by itself, and return its size and data; None if that cannot be."""
    unpacker = raw_unpacker()
    try:
        data: bytes = unpacker.decompress(part, _MOST_INFLATED)
        end = b"" if unpacker.eof or unpacker.unconsumed_tail else unpacker.decompress(_END, _MOST_INFLATED)
    except ERRORS:
        return len(part), None
    whole = unpacker.eof and not unpacker.unused_data and not end and data
    return len(part), data if whole else None
