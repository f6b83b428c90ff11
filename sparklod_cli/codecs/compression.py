"""Compression by gzip and zstd: a writer of a gzip member on several threads, and readers of both piece by piece.

zlib-ng deflates; benchmarks/notes/file-sizes.md explains why its own threaded gzip is not used. ISA-L inflates if the
package isal is installed, else zlib-ng, with the same result; docs/decisions/05-spz.md has their speeds.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, BinaryIO

from zlib_ng import zlib_ng

from ..system.errors import ChecksumError, FormatError, PromiseError, TooLongError, TruncatedError
from ..system.progress import Progress
from ..system.threads import ordered_map
from .formats import DEFAULT_COMPRESSION

GZIP_MAGIC = b"\x1f\x8b"
#: First bytes of a deflated member whose header consists of ten bytes, and of one with a comment behind these, which
#: ends with a zero byte (RFC 1952).
PLAIN_HEAD, COMMENTED_HEAD = GZIP_MAGIC + b"\x08\0", GZIP_MAGIC + b"\x08\x10"

#: Bytes of a block, which one thread deflates without references to the blocks before: this makes files 0.05 to 0.2 %
#: larger (docs/decisions/05-spz.md).
BLOCK = 1 << 19

#: Bytes at the beginning of a block on which the ways to deflate it are compared.
TRIED = 1 << 16

#: How a block is deflated: the level, None for that of the user, and the strategy of zlib.
Way = tuple[int | None, int]

#: Ways to deflate, by kind of data. Each block is deflated in the first of those ways that make its beginning smallest.
#: Most bytes of splats are noise, which Huffman codes alone make as small as a search, in a third of the time. Colours
#: repeat in three bytes, and only level 9 searches for such short strings.
MIXED: tuple[Way, ...] = ((None, zlib_ng.Z_DEFAULT_STRATEGY),)
NOISE: tuple[Way, ...] = ((None, zlib_ng.Z_HUFFMAN_ONLY), *MIXED)
TRIPLES: tuple[Way, ...] = ((9, zlib_ng.Z_DEFAULT_STRATEGY), *MIXED)
RUNS: tuple[Way, ...] = ((None, zlib_ng.Z_RLE), *MIXED)
LINKS: tuple[Way, ...] = ((6, zlib_ng.Z_DEFAULT_STRATEGY),)

#: A header may announce this many bytes, or more if the file is expanded by at most `MAX_RATIO`. Real scenes reach a
#: ratio of 3; deflate's limit is 1000, which a scene of equal splats reaches.
TRUSTED_SIZE, MAX_RATIO = 1 << 26, 200

_RAW = -zlib_ng.MAX_WBITS


def gzip_member(
    pieces: Iterable[Any],
    runs: Sequence[tuple[int, tuple[Way, ...]]],
    level: int,
    threads: int,
    progress: Progress,
    *,
    comment: bytes = b"",
) -> Iterator[bytes]:
    """Yield one gzip member; the same bytes for any number of threads, and for any division of the data into pieces.

    Blocks are deflated separately and end on a byte boundary with an empty stored block, so that together they are one
    deflate stream.

    Args:
        pieces: bytes or contiguous arrays, consumed a few blocks ahead.
        runs: sizes of consecutive data of one kind, and the ways to deflate them. A block holds data of one run, unless
            all data fit into one block.
        level: compression level. Below the default, all ways have this level; otherwise, they have at least this level.
        comment: comment of the header, without a zero byte; empty for none.
    """
    total = sum(size for size, _ in runs)
    parts: list[tuple[int, tuple[Way, ...]]] = [(total, ((level, zlib_ng.Z_DEFAULT_STRATEGY),))]
    if total > BLOCK:
        parts, hasty = [], level < DEFAULT_COMPRESSION
        for size, ways in runs:
            levels = [level if least is None or hasty else max(level, least) for least, _ in ways]
            chosen = tuple(dict.fromkeys(zip(levels, (strategy for _, strategy in ways), strict=True)))
            parts += [(min(BLOCK, size - start), chosen) for start in range(0, size, BLOCK)]
    blocks = blocks_of_pieces(pieces, [size for size, _ in parts])
    items = zip(blocks, (ways for _, ways in parts), [False] * (len(parts) - 1) + [True], strict=True)
    # No name, no time, no system: the same scene gives the same bytes.
    head, rest = (COMMENTED_HEAD, comment + b"\0") if comment else (PLAIN_HEAD, b"")
    yield head + b"\0\0\0\0\0\xff" + rest
    check = done = 0
    for block, packed in ordered_map(lambda each: _deflated(*each), items, threads):
        yield packed
        check, done = zlib_ng.crc32(block, check), done + len(block)
        progress("writing", done, total, "B")
    yield struct.pack("<II", check, total & 0xFFFFFFFF)


def _deflated(block: memoryview, ways: tuple[Way, ...], last: bool) -> tuple[memoryview, bytes]:
    way = min(ways, key=lambda way: len(_packed(block[:TRIED], way, last=True))) if len(ways) > 1 else ways[0]
    return block, _packed(block, way, last=last)


def _packed(block: memoryview, way: Way, *, last: bool) -> bytes:
    level, strategy = way
    packer = zlib_ng.compressobj(level, zlib_ng.DEFLATED, _RAW, zlib_ng.DEF_MEM_LEVEL, strategy)
    packed: bytes = packer.compress(block) + packer.flush(zlib_ng.Z_FINISH if last else zlib_ng.Z_SYNC_FLUSH)
    return packed


def blocks_of_pieces(pieces: Iterable[Any], sizes: Iterable[int]) -> Iterator[memoryview]:
    """Divide the data of pieces into blocks of given sizes; raises ValueError if the sizes do not add up.

    A block that lies within one piece is a view of it.
    """
    views = (memoryview(piece).cast("B") for piece in pieces if memoryview(piece).nbytes)
    view = memoryview(b"")
    for size in sizes:
        parts = []
        while size > 0:
            view = view or next(views, view)
            if not view:
                raise ValueError(f"{size} bytes of a block are missing")
            parts.append(view[:size])
            view = view[len(parts[-1]) :]
            size -= len(parts[-1])
        yield parts[0] if len(parts) == 1 else memoryview(b"".join(parts))
    if view or next(views, None) is not None:
        raise ValueError("there are more data than blocks")


def check_promise(total: int, file_size: int) -> None:
    """Raise `PromiseError` if a header announces more bytes than a file of this size can contain."""
    if total > TRUSTED_SIZE and total > MAX_RATIO * file_size:
        raise PromiseError(f"its header announces {total:,} bytes, more than a file of {file_size:,} bytes can hold")


def zstd_frame(pieces: Iterable[Any], size: int, level: int) -> bytes:
    """Compress pieces, `size` bytes together, to one zstd frame with a checksum.

    Args:
        pieces: bytes or contiguous arrays.
        level: level of deflate, 1 to 9, which is mapped to 3 to 19 of zstd.
    """
    import zstandard

    packer = zstandard.ZstdCompressor(level=2 * level + 1, write_checksum=True).compressobj(size=size)
    return b"".join([*(packer.compress(memoryview(piece).cast("B")) for piece in pieces), packer.flush()])


try:
    from isal import isal_zlib as _library
except ImportError:
    _library = zlib_ng

#: Errors of unpackers for data that are no deflate stream.
INFLATE_ERRORS: tuple[Any, ...] = (zlib_ng.error, _library.error)  # the stubs take the classes for instances

#: Bytes of a header without optional fields.
_HEAD_SIZE = 10
#: Longest comment that is read, bytes; those of sparklod have some fifty.
MOST_COMMENT = 1 << 12

#: Bytes that are read from a file at a time, and most bytes that they are inflated to at a time.
PIECE, _STEP = 1 << 17, 1 << 18


def raw_unpacker() -> Any:
    """Return a decompressor of a bare deflate stream, which raises `INFLATE_ERRORS`."""
    return _library.decompressobj(-zlib_ng.MAX_WBITS)


class Inflate:
    """Reader of a gzip member of a file.

    Args:
        file: binary file at the beginning of the member; nobody else may use it until the last read.

    Attributes:
        comment: comment in the header of the member, or empty; None if it is too long or there are other fields.
        end: position behind the member in the file; None until the member has been read to its end.
        behind: the first two bytes after the member, or fewer at the end of the file; empty before `end` is known.
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
        """Read the next `size` bytes, or fewer at the end of the data; raises `FormatError` if they are corrupt."""
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
        library = zlib_ng if self.comment is None else _library  # ISA-L misreads headers that continue in the next read
        unpacker, packed = library.decompressobj(zlib_ng.MAX_WBITS + 16), b""
        self._file.seek(self._start)
        while not unpacker.eof:
            packed = unpacker.unconsumed_tail or self._file.read(PIECE)
            try:
                piece: bytes = unpacker.decompress(packed, _STEP)
            except INFLATE_ERRORS as error:
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


class Unzstd:
    """Reader of a zstd frame, the next `packed` bytes of a file, for a stream of this name in messages."""

    def __init__(self, file: BinaryIO, packed: int, name: str) -> None:
        import zstandard

        def read(size: int) -> bytes:
            nonlocal packed
            data = file.read(min(size, packed))
            packed -= len(data)
            return data

        self._name, self._error = name, zstandard.ZstdError
        source: Any = SimpleNamespace(read=read)
        self._reader = zstandard.ZstdDecompressor().stream_reader(source, read_size=PIECE)

    def read(self, size: int) -> bytes:
        """Read the next `size` bytes, or fewer at the end of the data; raises `FormatError` if they are corrupt."""
        try:
            piece: bytes = self._reader.read(size)
        except self._error as error:
            kind = ChecksumError if "checksum" in str(error) else FormatError
            raise kind(f"corrupt zstd data in stream {self._name}: {error}") from None
        return piece

    def finish(self) -> None:
        """Raise `FormatError` unless the stream ends here."""
        if self.read(1):
            raise TooLongError(f"stream {self._name} is longer than its table announces")
