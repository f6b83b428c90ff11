"""Files as streams of rows: decoded chunk by chunk, so that a file never lies in memory as a whole."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..support.errors import TruncatedError
from ..support.parallel import CHUNK, chunks_of, ordered_map
from ..support.progress import Progress

#: Narrow rows, such as the columns of SPZ, would otherwise be over before a thread has been handed them.
CHUNK_BYTES = 1 << 18

#: A run of rows: which they are, and their content.
Rows = tuple[slice, NDArray[Any]]

#: The next `size` bytes, or fewer where the data ends.
Read = Callable[[int], bytes]


def size_of(file: BinaryIO) -> int:
    """Bytes of a file; leaves it at its beginning."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return size


def rows_of(read: Read, row_type: np.dtype[Any], count: int, what: str = "splats") -> Iterator[Rows]:
    """`count` rows in chunks of at least CHUNK rows and CHUNK_BYTES, read as they are asked for.

    Raises:
        FormatError: the data ends before that.
    """
    for part in chunks_of(count, max(CHUNK, CHUNK_BYTES // row_type.itemsize)):
        data = read((part.stop - part.start) * row_type.itemsize)
        whole = len(data) // row_type.itemsize
        if part.start + whole < part.stop:
            raise TruncatedError(f"cut short after {part.start + whole:,} of {count:,} {what}")
        yield part, np.frombuffer(data, row_type)


def decode_rows(
    rows: Iterator[Rows], decode: Callable[[slice, NDArray[Any]], None], count: int, threads: int, progress: Progress
) -> None:
    """Calls `decode` with every run of rows, on several threads; this one reads meanwhile."""

    def run(item: Rows) -> int:
        part, content = item
        decode(part, content)
        return part.stop

    for done in ordered_map(run, rows, threads):
        progress("reading", done, count, "splat")
