"""Reads the header of a RAD file, or one of its chunks, and no other bytes."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ..codecs.rad import rad_rules
from ..codecs.rad.codec import RadChunk, read_chunk
from ..codecs.rad.rad_header import RadHeader, read_header
from ..codecs.rad.rad_reader import file_of
from ..codecs.validation import check_rules
from ..model.splats import FloatArray
from ..support.errors import UnreadableError
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
        palette: that of the first chunk, see `codecs.rad.codec.read_chunk`.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        ValueError: there is no such chunk.
    """
    with _opened(path) as file:
        header = _header(file)
        if not 0 <= number < len(header.chunks):
            raise ValueError(f"number is {number}; its chunks are 0 to {len(header.chunks) - 1}")
        entry = header.chunks[number]
        with file_of(entry, file, functools.partial(open_beside, path)) as source:
            return read_chunk(source, entry, header, palette)


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
    header = read_header(file)
    check_rules(rad_rules.violations(header))
    return header
