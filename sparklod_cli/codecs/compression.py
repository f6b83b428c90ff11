"""Compression: writes one gzip member on several threads, and inflates without buffering more than requested.

docs/decisions explains why the library's own threaded gzip is not used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import zstandard
from zlib_ng import zlib_ng

from ..support.defaults import DEFAULT_COMPRESSION
from ..support.errors import ChecksumError, FormatError, PromiseError, TooLongError, TruncatedError
from ..support.parallel import ordered_map
from ..support.progress import Progress

#: Bytes of a block that one thread deflates, bytes before a block that it may refer to (deflate's window), and bytes of
#: a file that are read at a time.
BLOCK, WINDOW, PIECE = 1 << 18, 1 << 15, 1 << 17

#: The level of links, the only data in which a longer search finds something: 10 % of them, 0.5 to 1 % of a file.
LINKS_LEVEL = 9

#: Bytes up to which the size announced by a header is accepted; beyond, a file may expand by at most `MAX_RATIO`. Real
#: scenes reach a ratio of 3; deflate's limit is 1000, which a scene of equal splats reaches.
TRUSTED_SIZE, MAX_RATIO = 1 << 26, 200

_ZlibError: Any = zlib_ng.error  # the stubs take the class for an instance
GZIP_MAGIC = b"\x1f\x8b"
_RAW, _GZIP = -zlib_ng.MAX_WBITS, zlib_ng.MAX_WBITS + 16


def gzip_member(
    pieces: Iterable[Any],
    total: int,
    level: int,
    threads: int,
    progress: Progress,
    *,
    links_from: int | None = None,
) -> Iterator[bytes]:
    """One gzip member, piece by piece; the same bytes for any number of threads, and however the data are cut.

    As in pigz, blocks are deflated separately, each with the end of the previous one as its dictionary, and end on a
    byte boundary with an empty stored block, so that together they are one deflate stream.

    Args:
        pieces: bytes, or contiguous arrays, asked for a few blocks ahead.
        total: their bytes.
        level: of compression.
        threads: to deflate on.
        progress: told of the bytes.
        links_from: where links of a tree begin, which are the last data: a block that begins there or behind is
            deflated at `LINKS_LEVEL`, unless the level is below the default, which means haste. None without links.
    """
    check = 0
    links_from = total if links_from is None or level < DEFAULT_COMPRESSION else links_from

    def blocks() -> Iterator[tuple[memoryview, memoryview, bool, int]]:
        nonlocal check
        before, at = memoryview(b""), 0
        for block in blocks_of_pieces(pieces, BLOCK):
            of_block = LINKS_LEVEL if at >= links_from else level
            check, at = zlib_ng.crc32(block, check), at + len(block)
            yield before, block, at >= total, of_block
            before = block[-WINDOW:]

    yield b"\x1f\x8b\x08\0\0\0\0\0\0\xff"  # no name, no time, no system: the same scene gives the same bytes
    done = 0
    for size, packed in ordered_map(lambda each: _deflated(*each), blocks(), threads):
        yield packed
        done += size
        progress("writing", done, total, "B")
    yield struct.pack("<II", check, total & 0xFFFFFFFF)


def _deflated(before: memoryview, block: memoryview, last: bool, level: int) -> tuple[int, bytes]:
    """The bytes of a block, and its part of a deflate stream, in which it comes after the bytes `before`."""
    memory, strategy = zlib_ng.DEF_MEM_LEVEL, zlib_ng.Z_DEFAULT_STRATEGY
    packer = zlib_ng.compressobj(level, zlib_ng.DEFLATED, _RAW, memory, strategy, zdict=before)
    return len(block), packer.compress(block) + packer.flush(zlib_ng.Z_FINISH if last else zlib_ng.Z_SYNC_FLUSH)


def blocks_of_pieces(pieces: Iterable[Any], size: int) -> Iterator[memoryview]:
    """The data of pieces in blocks of `size` bytes; the last may be shorter, and is empty where there are no data.

    A block that lies within one piece is a view of it.
    """
    rest: list[memoryview] = []
    missing = size
    block = None
    for piece in pieces:
        view = memoryview(piece)
        view = view.cast("B") if view.nbytes else memoryview(b"")
        while len(view) >= missing:
            block = view[:missing] if missing == size else memoryview(b"".join([*rest, view[:missing]]))
            view, rest, missing = view[missing:], [], size
            yield block
        if len(view):
            rest.append(view)
            missing -= len(view)
    if rest or block is None:
        yield memoryview(b"".join(rest))


def check_promise(total: int, file_size: int) -> None:
    """Raises `PromiseError` if a header announces more bytes than a file of this size can expand to."""
    if total > TRUSTED_SIZE and total > MAX_RATIO * file_size:
        raise PromiseError(f"its header announces {total:,} bytes, more than a file of {file_size:,} bytes can hold")


class Inflate:
    """Reads a gzip member of a file, buffering little more than requested."""

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
        """Checks that the member ends here with a correct checksum.

        Args:
            allow_more: the member may go on with data that are not read; nothing is checked.

        Raises:
            FormatError: the member does not end here, or the checksum is wrong.
        """
        if allow_more:
            return
        if self.read(1):
            raise TooLongError("it holds more data than its header announces")
        if not self._unpacker.eof:
            raise TruncatedError("cut short: the gzip checksum is missing")

    def behind(self) -> bytes:
        """The first two bytes after the member, or fewer at the end of the file; empty before the member has ended."""
        if not self._unpacker.eof:
            return b""
        rest: bytes = self._unpacker.unused_data
        at = self._file.tell()
        more = self._file.read(2)
        self._file.seek(at)
        return (rest + more)[:2]

    def end(self) -> int:
        """The position of the end of the member in the file, once it has been read."""
        return self._file.tell() - len(self._unpacker.unused_data)


class _Window:
    """A file of the next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int) -> bytes:
        data = self._file.read(min(size, self._left))
        self._left -= len(data)
        return data


class Unzstd:
    """Reads a zstd frame, the next `packed` bytes of a file, buffering little more than requested."""

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
            raise TooLongError(f"stream {self._name} is longer than its table announces")
