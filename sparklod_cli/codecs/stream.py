"""Files as streams of rows, decoded and encoded in blocks, so that a file is never in memory as a whole."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..system.errors import TruncatedError
from ..system.progress import Progress
from ..system.threads import BLOCK_ROWS, blocks_of, ordered_map

#: Least bytes of a block: with narrow rows, such as SPZ's streams, handing a smaller one to a thread costs more than it
#: saves.
BLOCK_BYTES = 1 << 18

#: A block of rows: which rows, and their content.
Rows = tuple[slice, NDArray[Any]]

#: Reads the next `size` bytes, or fewer at the end of the data.
Read = Callable[[int], bytes | memoryview]


def size_of(file: BinaryIO) -> int:
    """Return the bytes of a file, which is left at its beginning."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return size


class Positioned:
    """A file that is read by position, by several threads at once, whatever else reads it.

    Args:
        file: open for reading, until the last read.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._lock = threading.Lock()
        plain = isinstance(getattr(file, "raw", None), io.FileIO) and hasattr(os, "pread")
        self._descriptor = file.fileno() if plain else None

    def read(self, at: int, size: int) -> bytes:
        """Return the `size` bytes from `at` on, or fewer at the end of the file."""
        if self._descriptor is None:
            with self._lock:
                self._file.seek(at)
                return self._file.read(size)
        data = os.pread(self._descriptor, size, at)
        while 0 < len(data) < size:  # a read may give less, at most 2 GiB
            more = os.pread(self._descriptor, size - len(data), at + len(data))
            if not more:
                break
            data += more
        return data

    def reader(self, at: int) -> Read:
        """Return a reader that resumes at an offset (not thread-safe)."""

        def read(size: int) -> bytes:
            nonlocal at
            data = self.read(at, size)
            at += len(data)
            return data

        return read


def rows_between(
    file: Positioned,
    offset: int,
    row_type: np.dtype[Any],
    start: int,
    stop: int,
    count: int,
    subject: str = "splats",
) -> Iterator[Rows]:
    """Read rows from `start` to `stop`, of `count` that begin at `offset` in a file; blocks and errors as `rows_of`."""
    read = file.reader(offset + start * row_type.itemsize)
    return rows_of(read, row_type, start, stop, count, subject)


def rows_of(
    read: Read, row_type: np.dtype[Any], start: int, stop: int, count: int, subject: str = "splats"
) -> Iterator[Rows]:
    """Read rows from `start` to `stop`, of `count`, in blocks of at least `BLOCK_ROWS` rows and `BLOCK_BYTES` bytes.

    Raises:
        TruncatedError: the data ends early.
    """
    step = max(BLOCK_ROWS, BLOCK_BYTES // row_type.itemsize)
    for first in range(start, stop, step):
        part = slice(first, min(first + step, stop))
        data = read((part.stop - part.start) * row_type.itemsize)
        whole = len(data) // row_type.itemsize
        if part.start + whole < part.stop:
            raise TruncatedError(f"cut short after {part.start + whole:,} of {count:,} {subject}")
        yield part, np.frombuffer(data, row_type)


def decode_rows(
    rows: Iterator[Rows], decode: Callable[[slice, NDArray[Any]], None], count: int, threads: int, progress: Progress
) -> None:
    """Call `decode` with every block of rows, on several threads, while this thread reads on."""

    def run(item: Rows) -> int:
        part, content = item
        decode(part, content)
        return part.stop

    for done in ordered_map(run, rows, threads):
        progress("reading", done, count, "splat")


def encode_rows(encode: Callable[[slice], bytes], count: int, threads: int, progress: Progress) -> Iterator[bytes]:
    """Return the bytes of `count` rows in order: `encode` is called with blocks of rows, on several threads."""
    parts = blocks_of(count)
    for part, piece in zip(parts, ordered_map(encode, parts, threads), strict=True):
        yield piece
        progress("writing", part.stop, count, "splat")
