"""Stores of results: in a folder, which several machines may mount, or at an address, in files of one layout."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import struct
import threading
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...system import atomic
from ...system.addresses import Address, Place
from ...system.errors import ScratchError

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


#: The file of a result, open.
_File = FileIO | BufferedReader


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
        """Size of the array, bytes."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        """Size of one row, bytes."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize


def encode(arrays: Arrays) -> Iterator[bytes | memoryview]:
    """Yield the bytes of a result in pieces; nothing of an array that is C-contiguous is copied.

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


def read_table(file: _File, size: int) -> dict[str, Entry]:
    """Return the arrays of a result by name, of its file of so many bytes.

    Raises:
        DamagedError: it is no result, its table is damaged, or it has another length than when it was written.
    """
    file.seek(0)
    head = file.read(HEAD.size)
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise DamagedError("it does not begin as a result")
    _, length, checksum, end = HEAD.unpack(head)
    if length > MAX_TABLE:
        raise DamagedError(f"its table has {length:,} bytes")
    text = file.read(length)
    if len(text) != length or zlib.crc32(text) != checksum:
        raise DamagedError("its table is damaged")
    if end != size:
        raise DamagedError(f"it has {size:,} bytes of {end:,}")
    entries, at = {}, HEAD.size + length
    for name, dtype, shape, each in json.loads(text):
        entries[name] = Entry(np.dtype(dtype), tuple(shape), _aligned(at), each)
        at = _aligned(at) + entries[name].bytes
    return entries


def check(entry: Entry, pieces: Iterable[NDArray[Any]]) -> None:
    """Raise `DamagedError` where the bytes of an array, in pieces, are not those that were written."""
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


#: Suffix of the files of results, so that a result may have the name of a folder of others.
SUFFIX = ".result"

#: Bytes that are read at once of a result that is only checked.
CHECK_BYTES = 1 << 24

#: Bytes that are read at once at an address: the head and the table of most results.
READ_AHEAD = 1 << 16

#: Rows between those that are wanted, up to which they are read along rather than in another go. Chosen: some 10 KB.
GAP = 128

#: What the system says of a disk, or a share of one, that is full.
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}


class Traffic:
    """Bytes of results that a store has written and read in this process; a copy in another one begins at 0."""

    def __init__(self) -> None:
        self.written = self.read = 0
        self._lock = threading.Lock()

    def add(self, *, written: int = 0, read: int = 0) -> None:
        """Count bytes; may be called by several threads at once."""
        with self._lock:
            self.written += written
            self.read += read

    def __reduce__(self) -> tuple[type[Traffic], tuple[()]]:
        return Traffic, ()


class Store:
    """Results of tasks by name, each a file that appears whole or not at all, with arrays by key.

    Small, so that it can be pickled. Methods may be called by several threads at once, and raise `ScratchError` where
    results cannot be read or written. A checksum of each array, in its file, tells what was damaged. `get` compares it,
    `rows` does not; `is_sound` reads all of a result for that, as a bake does that resumes.

    Files are not synced, which would take half of the time of writing: what a process has written is there when the
    process is killed, and checksums tell what a power failure damaged. At an address, an object appears when all of it
    was sent.

    Attributes:
        folder: of the files, on this machine, mounted by several, or at an address; made when the first result is put.
        traffic: what was written and read by this process.
    """

    def __init__(self, folder: Place) -> None:
        self.folder = folder
        self.traffic = Traffic()
        self._tables: dict[str, tuple[int, dict[str, Entry]]] = {}  # with the bytes of the file
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[Store], tuple[Place]]:
        return type(self), (self.folder,)

    def __str__(self) -> str:
        return str(self.folder)

    def names(self) -> list[str]:
        """Return the names of all results, in order."""
        folder = self.folder
        if isinstance(folder, Path):
            files = folder.rglob(f"*{SUFFIX}")
            return sorted(path.relative_to(folder).as_posix().removesuffix(SUFFIX) for path in files)
        with self._translated("read"):
            return [name.removesuffix(SUFFIX) for name in folder.files() if name.endswith(SUFFIX)]

    def _place(self, name: str) -> Place:
        """Return the file of a result."""
        return self.folder / f"{name}{SUFFIX}"

    def _open(self, name: str) -> _File:
        """Open the file of a result."""
        place = self._place(name)
        if isinstance(place, Path):
            return place.open("rb", buffering=0)
        size, _ = self._tables.get(name, (None, {}))
        return place.open(buffering=READ_AHEAD, size=size)

    def _write(self, name: str, pieces: Iterable[bytes | memoryview]) -> int:
        """Write the file of a result, which appears when it is whole; return its size."""
        place = self._place(name)
        if isinstance(place, Address):
            return place.write(pieces)
        place.parent.mkdir(parents=True, exist_ok=True)
        return atomic.write(place, pieces, overwrite=True, sync=False)

    def has(self, name: str) -> bool:
        """Return whether there is a result, in a folder of the length that it was written with."""
        place = self._place(name)
        with self._translated("read"):
            if isinstance(place, Address):
                return place.is_file()
            with contextlib.suppress(FileNotFoundError, NotADirectoryError, DamagedError), self._open(name) as file:
                self._table(name, file)
                return True
        return False

    def put(self, name: str, arrays: Arrays) -> None:
        """Write a result; replaces one of this name."""
        self._forget(name)
        with self._translated("write"):
            self.traffic.add(written=self._write(name, encode(arrays)))

    def get(self, name: str, keys: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
        """Read a result, or some of its arrays, and compare their checksums."""
        found = {}
        with self._reading(name) as (file, table):
            for key in table if keys is None else keys:
                entry = table[key]
                found[key] = _filled(file, entry.offset, np.empty(entry.shape, entry.dtype))
                check(entry, [found[key]])
                self.traffic.add(read=entry.bytes)
        return found

    def rows(self, name: str, key: str, start: int, stop: int) -> NDArray[Any]:
        """Read rows of an array and nothing else."""
        with self._reading(name) as (file, table):
            entry = table[key]
            start, stop, _ = slice(start, stop).indices(entry.shape[0])
            rows = np.empty((max(0, stop - start), *entry.shape[1:]), entry.dtype)
            _filled(file, entry.offset + start * entry.row_bytes, rows)
        self.traffic.add(read=rows.nbytes)
        return rows

    def rows_at(self, name: str, key: str, index: NDArray[np.int64]) -> NDArray[Any]:
        """Read rows of an array by their ascending numbers, at least one; those between that are near are read, too."""
        cuts = np.flatnonzero(np.diff(index) > GAP) + 1
        first = index[np.concatenate([[0], cuts])]
        count = index[np.concatenate([cuts, [len(index)]]) - 1] + 1 - first
        begin = np.cumsum(count) - count
        with self._reading(name) as (file, table):
            entry = table[key]
            rows = np.empty((int(count.sum()), *entry.shape[1:]), entry.dtype)
            for row, at, number in zip(first.tolist(), begin.tolist(), count.tolist(), strict=True):
                _filled(file, entry.offset + row * entry.row_bytes, rows[at : at + number])
        self.traffic.add(read=rows.nbytes)
        if len(rows) == len(index):
            return rows
        in_cut = np.diff(np.concatenate([[0], cuts, [len(index)]]))
        return rows[index - np.repeat(first - begin, in_cut)]

    def shape(self, name: str, key: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        with self._reading(name) as (_, table):
            return table[key].shape

    def remove(self, name: str) -> None:
        """Remove a result, if it is there."""
        self._forget(name)
        with self._translated("write"):
            self._place(name).unlink(missing_ok=True)

    def is_sound(self, name: str) -> bool:
        """Return whether a result is there, and has the bytes that were put; reads all of it."""
        self._forget(name)
        if not self.has(name):
            return False
        with self._translated("read"), contextlib.suppress(FileNotFoundError, DamagedError), self._open(name) as file:
            for entry in self._table(name, file).values():
                check(entry, _pieces(file, entry))
                self.traffic.add(read=entry.bytes)
            return True
        return False

    def _forget(self, name: str) -> None:
        with self._lock:
            self._tables.pop(name, None)

    def _table(self, name: str, file: _File) -> dict[str, Entry]:
        """Return the table of a file that is open, which is read once."""
        size = file.seek(0, os.SEEK_END)
        with self._lock:
            known, table = self._tables.get(name, (None, {}))
        if known != size:
            table = read_table(file, size)
            with self._lock:
                self._tables[name] = size, table
        return table

    @contextlib.contextmanager
    def _reading(self, name: str) -> Iterator[tuple[_File, dict[str, Entry]]]:
        """Yield the file of a result, and its table."""
        with self._translated("read"):
            try:
                with self._open(name) as file:
                    yield file, self._table(name, file)
            except DamagedError as error:
                raise ScratchError(
                    f"{name} in the scratch folder {self.folder} is damaged: {error}; run it again with --resume, which"
                    " makes it anew"
                ) from None
            except (FileNotFoundError, NotADirectoryError):
                raise ScratchError(
                    f"{name} is missing in the scratch folder {self.folder}: somebody removed it; begin anew with"
                    " --overwrite, without --resume"
                ) from None

    @contextlib.contextmanager
    def _translated(self, action: str) -> Iterator[None]:
        """Turn errors of the system into `ScratchError`."""
        try:
            yield
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            if error.errno in FULL:
                raise ScratchError(
                    f"there is no room left in the scratch folder {self.folder}: {reason}; free some and run it again"
                    " with --resume, or choose another disk with --scratch-dir"
                ) from None
            raise ScratchError(
                f"cannot {action} in the scratch folder {self.folder}: {reason}; choose another one with --scratch-dir"
            ) from None


def _filled(file: _File, offset: int, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array with the bytes of a file."""
    view = array.reshape(-1).view(np.uint8).data
    file.seek(offset)
    while view:
        count = file.readinto(view)
        if not count:
            raise DamagedError("it is cut short")
        view = view[count:]
    return array


def _pieces(file: _File, entry: Entry) -> Iterator[NDArray[Any]]:
    """Yield the bytes of an array, some at a time."""
    for start in range(0, entry.bytes, CHECK_BYTES):
        piece = np.empty(min(CHECK_BYTES, entry.bytes - start), np.uint8)
        yield _filled(file, entry.offset + start, piece)
