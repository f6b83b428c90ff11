"""Compression: writes one gzip member on several threads, and zstd frames, which it reads in small pieces.

benchmarks/notes/file-sizes.md explains why the library's own threaded gzip is not used. `inflate` reads gzip.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import zstandard
from zlib_ng import zlib_ng

from ..system.errors import ChecksumError, FormatError, PromiseError, TooLongError
from ..system.progress import Progress
from ..system.threads import ordered_map
from .inflate import COMMENTED_HEAD, PLAIN_HEAD
from .options import DEFAULT_COMPRESSION

#: Bytes of a block that one thread deflates by itself, and bytes that are read at a time. That blocks of
#: this size refer to none before them costs 0.05 to 0.2 % of a file (docs/decisions/05-spz.md).
BLOCK, PIECE = 1 << 19, 1 << 17

#: Bytes at the beginning of a block on which the ways to deflate it are compared.
TRIED = 1 << 16


class Way(NamedTuple):
    """Deflate settings of a block: the level, None for the one that was chosen, and the strategy of zlib."""

    level: int | None = None
    strategy: int = zlib_ng.Z_DEFAULT_STRATEGY


#: Ways by kind of data; the one that makes the beginning of a block smallest is taken, the first of those that are
#: equal. Most bytes of splats are noise, of which codes of Huffman make as little as a search does, in a third of the
#: time; colours repeat in three bytes, which only level 9 looks for.
MIXED = (Way(),)
NOISE = (Way(strategy=zlib_ng.Z_HUFFMAN_ONLY), Way())
TRIPLES = (Way(9), Way())
RUNS = (Way(strategy=zlib_ng.Z_RLE), Way())
LINKS = (Way(6),)

#: Bytes up to which the size announced by a header is accepted; beyond, a file may expand by at most `MAX_RATIO`. Real
#: scenes reach a ratio of 3; deflate's limit is 1000, which a scene of equal splats reaches.
TRUSTED_SIZE, MAX_RATIO = 1 << 26, 200

_RAW = -zlib_ng.MAX_WBITS


class DataRun(NamedTuple):
    """Bytes of data of one kind, and the ways to deflate them."""

    size: int
    ways: tuple[Way, ...] = MIXED


def gzip_member(
    pieces: Iterable[Any],
    runs: Sequence[DataRun],
    level: int,
    threads: int,
    progress: Progress,
    *,
    comment: bytes = b"",
) -> Iterator[bytes]:
    """Return one gzip member, piece by piece; the same bytes for any number of threads, and however the data are cut.

    Blocks are deflated separately, without a reference to one before, and end on a byte boundary with an empty stored
    block, so that together they are one deflate stream.

    Args:
        pieces: bytes, or contiguous arrays, asked for a few blocks ahead.
        runs: what they hold, in order. A block holds data of one, unless all fit into a block.
        level: of compression. Below the default, which means haste, no other is used, and above it no lower one.
        comment: of the header, without a zero byte; empty for none.
    """
    check = 0
    total = sum(run.size for run in runs)

    def blocks() -> Iterator[tuple[memoryview, bool, tuple[Way, ...]]]:
        nonlocal check
        at, parts = 0, list(_parts_of(runs, level))
        for (_, ways), block in zip(parts, blocks_of_pieces(pieces, [size for size, _ in parts]), strict=True):
            check, at = zlib_ng.crc32(block, check), at + len(block)
            yield block, at >= total, ways

    # No name, no time, no system: the same scene gives the same bytes.
    head, rest = (COMMENTED_HEAD, comment + b"\0") if comment else (PLAIN_HEAD, b"")
    yield head + b"\0\0\0\0\0\xff" + rest
    done = 0
    for size, packed in ordered_map(lambda each: _deflated(*each), blocks(), threads):
        yield packed
        done += size
        progress("writing", done, total, "B")
    yield struct.pack("<II", check, total & 0xFFFFFFFF)


def _parts_of(runs: Sequence[DataRun], level: int) -> Iterator[DataRun]:
    """Return the blocks of a member, one at least, and the ways to deflate each at a level."""
    total = sum(run.size for run in runs)
    if total <= BLOCK:
        yield DataRun(total, (Way(level),))
        return
    for run in runs:
        ways = tuple(dict.fromkeys(_at_level(way, level) for way in run.ways))
        for start in range(0, run.size, BLOCK):
            yield DataRun(min(BLOCK, run.size - start), ways)


def _at_level(way: Way, level: int) -> Way:
    """Return a way, with the level that it has where one was chosen."""
    if way.strategy != zlib_ng.Z_DEFAULT_STRATEGY:
        return way._replace(level=level)
    return Way(level if way.level is None or level < DEFAULT_COMPRESSION else max(level, way.level))


def _deflated(block: memoryview, last: bool, ways: tuple[Way, ...]) -> tuple[int, bytes]:
    """Deflate a block, and return its size and its part of a deflate stream."""
    way = min(ways, key=lambda way: len(_packed(block[:TRIED], way, last=True))) if len(ways) > 1 else ways[0]
    return len(block), _packed(block, way, last=last)


def _packed(block: memoryview, way: Way, *, last: bool) -> bytes:
    memory = zlib_ng.DEF_MEM_LEVEL
    packer = zlib_ng.compressobj(way.level, zlib_ng.DEFLATED, _RAW, memory, way.strategy)
    packed: bytes = packer.compress(block) + packer.flush(zlib_ng.Z_FINISH if last else zlib_ng.Z_SYNC_FLUSH)
    return packed


def blocks_of_pieces(pieces: Iterable[Any], sizes: Iterable[int]) -> Iterator[memoryview]:
    """Cut the data of pieces into blocks of these sizes, which may be 0; a block within one piece is a view of it.

    Raises:
        ValueError: the pieces hold more data, or fewer.
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
    """Raise `PromiseError` if a header announces more bytes than a file of this size can expand to."""
    if total > TRUSTED_SIZE and total > MAX_RATIO * file_size:
        raise PromiseError(f"its header announces {total:,} bytes, more than a file of {file_size:,} bytes can hold")


def zstd_frame(pieces: Iterable[Any], size: int, level: int) -> bytes:
    """Return one zstd frame, with a checksum.

    Args:
        pieces: bytes, or contiguous arrays, of `size` bytes together.
        level: of deflate, 1 to 9, for which zstd's from 3 to 19 stand.
    """
    packer = zstandard.ZstdCompressor(level=2 * level + 1, write_checksum=True).compressobj(size=size)
    return b"".join([*(packer.compress(memoryview(piece).cast("B")) for piece in pieces), packer.flush()])


class _Window:
    """The next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int) -> bytes:
        data = self._file.read(min(size, self._left))
        self._left -= len(data)
        return data


class Unzstd:
    """Reader of a zstd frame, the next `packed` bytes of a file, that buffers little more than requested."""

    def __init__(self, file: BinaryIO, packed: int, name: str) -> None:
        self._name = name
        window: Any = _Window(file, packed)
        self._reader = zstandard.ZstdDecompressor().stream_reader(window, read_size=PIECE)

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, or fewer where the data ends; raises `FormatError` where they are corrupt."""
        try:
            piece: bytes = self._reader.read(size)
        except zstandard.ZstdError as error:
            kind = ChecksumError if "checksum" in str(error) else FormatError
            raise kind(f"corrupt zstd data in stream {self._name}: {error}") from None
        return piece

    def finish(self) -> None:
        """Raise `FormatError` unless the stream ends here."""
        if self.read(1):
            raise TooLongError(f"stream {self._name} is longer than its table announces")
