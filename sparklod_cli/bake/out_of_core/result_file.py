"""The file of a result: a table of its arrays, and the arrays one after the other."""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Arrays of a result by name, empty or of any shape.
Arrays = Mapping[str, NDArray[Any]]

#: How a file begins; the digit is the version of its layout.
MAGIC = b"slresul1"

#: The magic, the bytes of the table, their CRC-32, and the bytes of the file.
HEAD = struct.Struct("<8sIIQ")

#: Arrays begin at multiples of this, so that they are aligned wherever a file is mapped or read.
ALIGNMENT = 64

#: Bytes of a table that are believed; those of results have some hundreds.
MAX_TABLE = 1 << 24


class DamagedError(ValueError):
    """A file is no result, or not all of it; the message says what is wrong."""


@dataclass(frozen=True)
class Entry:
    """An array of a result.

    Attributes:
        dtype: of its numbers, as numpy writes it.
        shape: of it.
        offset: bytes of the file before it.
        checksum: CRC-32 of its bytes.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    checksum: int

    @property
    def bytes(self) -> int:
        """Of all its numbers."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Of one row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize


@dataclass(frozen=True)
class Table:
    """The arrays of a result, by name.

    Attributes:
        entries: them.
        bytes: of the whole file.
    """

    entries: Mapping[str, Entry]
    bytes: int


def encode(arrays: Arrays) -> Iterator[bytes | memoryview]:
    """The bytes of a result in pieces; nothing of an array that is C-contiguous is copied.

    Raises:
        TypeError: an array has no plain numbers.
    """
    whole = {name: _plain(name, array) for name, array in arrays.items()}
    rows = [[name, array.dtype.str, list(array.shape), zlib.crc32(_bytes(array))] for name, array in whole.items()]
    table = json.dumps(rows, separators=(",", ":")).encode()
    end = start = _aligned(HEAD.size + len(table))
    for array in whole.values():
        end = _aligned(end) + array.nbytes
    yield HEAD.pack(MAGIC, len(table), zlib.crc32(table), end) + table + bytes(start - HEAD.size - len(table))
    at = start
    for array in whole.values():
        yield bytes(_aligned(at) - at)
        yield _bytes(array)
        at = _aligned(at) + array.nbytes


def table_bytes(head: bytes) -> int:
    """How many bytes follow the head, and are the table.

    Raises:
        DamagedError: it is no head of a result.
    """
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise DamagedError("it does not begin as a result")
    size: int = HEAD.unpack(head)[1]
    if size > MAX_TABLE:
        raise DamagedError(f"its table has {size:,} bytes")
    return size


def decode_table(head: bytes, text: bytes, file_bytes: int) -> Table:
    """The table of a file.

    Args:
        head, text: what it begins with.
        file_bytes: that it has.

    Raises:
        DamagedError: the table is damaged, or the file has another length than when it was written.
    """
    _, size, checksum, end = HEAD.unpack(head)
    if len(text) != size or zlib.crc32(text) != checksum:
        raise DamagedError("its table is damaged")
    if end != file_bytes:
        raise DamagedError(f"it has {file_bytes:,} bytes of {end:,}")
    entries, at = {}, HEAD.size + size
    for name, dtype, shape, each in json.loads(text):
        entries[name] = Entry(np.dtype(dtype), tuple(shape), _aligned(at), each)
        at = _aligned(at) + entries[name].bytes
    return Table(entries, end)


def check(entry: Entry, pieces: Iterable[NDArray[Any]]) -> None:
    """Raises `DamagedError` where the bytes of an array, in pieces, are not those that were written."""
    found = 0
    for piece in pieces:
        found = zlib.crc32(_bytes(piece), found)
    if found != entry.checksum:
        raise DamagedError("its checksum does not match")


def _plain(name: str, array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind not in "biufc":
        raise TypeError(f"{name} is an array of {array.dtype}; results have arrays of plain numbers")
    return np.ascontiguousarray(array).reshape(array.shape)


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT
