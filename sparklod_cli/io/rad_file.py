"""RAD files in parts: the header alone, one chunk, or chunk by chunk where a file may be larger than memory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ..codecs.format_rules import check_rules
from ..codecs.rad.rad_header import RadHeader, header_violations, read_header
from ..codecs.rad.rad_reader import RadChunk, RadReader, decoded_bytes, file_of, read_chunk
from ..model.splats import FloatArray
from ..system.errors import UnreadableError
from ..system.machine import available_memory
from .local_files import open_named
from .opening import opened, readable

#: Files whose decoded columns take more bytes than this, or than this share of the free memory, are read chunk by
#: chunk: computed values take as much again, and chunk by chunk is no slower
#: (docs/decisions/14-cuts.md).
AT_ONCE, SHARE = 1 << 28, 0.25


def fits(header: RadHeader) -> bool:
    """Return whether a file is small enough to be read at once."""
    free = available_memory()
    return decoded_bytes(header) <= (AT_ONCE if free is None else min(AT_ONCE, SHARE * free))


@contextlib.contextmanager
def reopened(path: Path, reader: RadReader) -> Iterator[RadReader]:
    """Open a file again, whose header was read; several threads may do so at a time."""
    with opened(path) as (source, _):
        yield dataclasses.replace(reader, file=source.file, open_companion=source.open_companion)


def read_rad_header(path: Path) -> RadHeader:
    """Read the header of a RAD file, whose chunks need not be there; raises `FormatError` if it breaks a fatal rule."""
    with _opened_header(path) as (_, header):
        return header


def read_rad_chunk(path: Path, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Read the header of a RAD file, and one chunk of it.

    Args:
        palette: that of the first chunk, see `rad_reader.read_chunk`.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        ValueError: there is no such chunk.
    """
    with _opened_header(path) as (file, header):
        if not 0 <= number < len(header.chunks):
            raise ValueError(f"number is {number}; its chunks are 0 to {len(header.chunks) - 1}")
        entry = header.chunks[number]
        with file_of(entry, file, functools.partial(open_named, path)) as source:
            return read_chunk(source, entry, header, palette)


@contextlib.contextmanager
def _opened_header(path: Path) -> Iterator[tuple[BinaryIO, RadHeader]]:
    with readable():
        if path.exists() and not path.is_file():
            raise UnreadableError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            header = read_header(file)
            check_rules(header_violations(header))
            yield file, header
