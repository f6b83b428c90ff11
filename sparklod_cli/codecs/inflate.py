"""Inflating: gzip members on one thread, without buffering more than a piece of a file and its data.

The one place that chooses the library for gzip: ISA-L (package isal) where it is installed, zlib-ng elsewhere. What
they inflate is the same; docs/decisions/05-spz.md has their speeds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, BinaryIO

from zlib_ng import zlib_ng

from ..system.errors import ChecksumError, FormatError, TooLongError, TruncatedError
from .compression import COMMENTED_HEAD, PLAIN_HEAD

try:
    from isal import isal_zlib as _library
except ImportError:
    _library = zlib_ng

#: What unpackers raise on data that are no deflate stream.
ERRORS: tuple[Any, ...] = (zlib_ng.error, _library.error)  # the stubs take the classes for instances

#: Bytes of the head of a member without fields.
_HEAD_SIZE = 10
#: Bytes up to which a comment is read; sparklod's have some fifty.
MOST_COMMENT = 1 << 12

#: Bytes of a file that are read at a time, and to which they are inflated at most.
PIECE, _STEP = 1 << 17, 1 << 18


def raw_unpacker() -> Any:
    """Return what inflates a bare deflate stream; it raises `ERRORS`."""
    return _library.decompressobj(-zlib_ng.MAX_WBITS)


class Inflate:
    """Reader of a gzip member of a file.

    Args:
        file: open for reading at the beginning of the member; nobody else may use it until the last read.

    Attributes:
        comment: of the head of the member, or empty; None if the head has other fields, or too long a comment.
        end: position in the file behind the member; None until the member has been read to its end.
        behind: the first two bytes after the member, or fewer at the end of the file; none before `end`.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._start = file, file.tell()
        self._pieces, self._rest = self._all_pieces(), memoryview(b"")
        self.comment: bytes | None = None
        self.end: int | None = None
        self.behind = b""
        head = file.read(_HEAD_SIZE)
        if head.startswith(PLAIN_HEAD):
            self.comment = b""
        elif head.startswith(COMMENTED_HEAD):
            comment, end, _ = file.read(MOST_COMMENT).partition(b"\0")
            self.comment = comment if end else None

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

    def finish(self) -> None:
        """Raise `FormatError` unless the member ends here with a correct checksum."""
        if self.read(1):
            raise TooLongError("it holds more data than its header announces")
        if self.end is None:
            raise TruncatedError("cut short: the gzip checksum is missing")

    def _all_pieces(self) -> Iterator[bytes]:
        """Yield the data in pieces, none of them empty."""
        library = zlib_ng if self.comment is None else _library  # ISA-L misreads heads of which a read ends in a field
        unpacker, packed = library.decompressobj(zlib_ng.MAX_WBITS + 16), b""
        self._file.seek(self._start)
        while not unpacker.eof:
            packed = unpacker.unconsumed_tail or self._file.read(PIECE)
            try:
                piece: bytes = unpacker.decompress(packed, _STEP)
            except ERRORS as error:
                wrong = "check" in str(error)  # "incorrect data check", "Incorrect checksum found"
                raise (ChecksumError if wrong else FormatError)(
                    "corrupt gzip data" + (": its checksum is wrong" if wrong else "")
                ) from None
            if piece:
                yield piece
            elif not packed and not unpacker.eof:
                return
        behind: bytes = unpacker.unused_data
        self.end = self._file.tell() - len(behind)
        self.behind = (behind[:2] + self._file.read(2))[:2]
