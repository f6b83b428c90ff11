"""Reads the header of a RAD file, or one of its chunks, and no other bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ..codecs.rad import codec as rad
from ..codecs.rad import promises as rad_promises
from ..codecs.rad.codec import RadChunk
from ..codecs.rad.header import RadChunkEntry, RadHeader, read_header
from ..codecs.stream import size_of
from ..model.splats import FloatArray
from ..support.errors import TruncatedError, UnreadableError
from .beside import open_beside
from .names import reason_of


def read_rad_header(path: Path) -> RadHeader:
    """Reads the header of a RAD file; its chunks need not be there.

    Raises:
        FormatError: it cannot be read, is no such header, or promises what cannot be.
    """
    with _opened(path) as file:
        return _header(file)


def read_rad_chunk(path: Path, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Reads the header of a RAD file, and one chunk of it.

    Args:
        path: of the file, or of the header whose chunks are files beside it.
        number: of the chunk, from 0.
        palette: that of the first chunk, see `rad.read_chunk`.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        ValueError: there is no such chunk.
    """
    with _opened(path) as file:
        header = _header(file)
        if not 0 <= number < len(header.chunks):
            raise ValueError(f"number is {number}; its chunks are 0 to {len(header.chunks) - 1}")
        entry = header.chunks[number]
        if entry.filename is None:
            return _chunk(file, entry, header, palette)
        with open_beside(path, entry.filename) as beside:
            return _chunk(beside, entry, header, palette)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        if path.exists() and not path.is_file():
            raise UnreadableError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise UnreadableError(f"cannot be read: {reason_of(error)}") from None


def _header(file: BinaryIO) -> RadHeader:
    rad.refuse_chunk(file)
    header = read_header(file)
    rad_promises.check(rad_promises.violations(header))
    return header


def _chunk(file: BinaryIO, entry: RadChunkEntry, header: RadHeader, palette: FloatArray | None) -> RadChunk:
    """A chunk, after a look at whether its file has as many bytes as memory would be asked for."""
    begin = entry.offset + (header.bytes if entry.filename is None else 0)
    if begin + entry.bytes > size_of(file):
        raise TruncatedError(f"cut short: a chunk of {entry.bytes:,} bytes begins at {begin:,}")
    return rad.read_chunk(file, entry, header, palette)
