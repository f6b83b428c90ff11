"""Where the chunks of a RAD file are: in the file of the header, or in files that it names."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import BinaryIO

from ...support.errors import FormatError, TruncatedError
from ..stream import size_of
from .records import RadChunkEntry, RadHeader

#: Opens a file that a header names; raises `FormatError` where it cannot.
Beside = Callable[[str], BinaryIO]


def size_beside(name: str, beside: Beside | None) -> int:
    """Bytes of a file that a header names; raises `FormatError` where it cannot be opened."""
    with _open(name, beside) as file:
        return size_of(file)


@contextlib.contextmanager
def file_of(entry: RadChunkEntry, file: BinaryIO, beside: Beside | None) -> Iterator[BinaryIO]:
    """The file that has a chunk: `file`, which has the header, or one that is closed afterwards."""
    if entry.filename is None:
        yield file
    else:
        with _open(entry.filename, beside) as own:
            yield own


def start_of(entry: RadChunkEntry, header: RadHeader) -> int:
    """Where a chunk begins in the file that has it."""
    return entry.offset + (header.bytes if entry.filename is None else 0)


def bytes_of(entry: RadChunkEntry, header: RadHeader, file: BinaryIO) -> bytes:
    """The bytes of a chunk.

    Args:
        entry: one of the header's.
        header: of the RAD file.
        file: that has the chunk, see `file_of`.

    Raises:
        TruncatedError: the file ends before the chunk does.
    """
    start = start_of(entry, header)
    lacking = start + entry.bytes - size_of(file)
    if lacking > 0:  # before so much memory is asked for
        raise TruncatedError(f"cut short: {lacking:,} of {entry.bytes:,} bytes of a chunk are missing")
    file.seek(start)
    return file.read(entry.bytes)


def _open(name: str, beside: Beside | None) -> BinaryIO:
    if beside is None:
        raise FormatError("its chunks are in files beside it; give it as a file in their folder")
    return beside(name)
