"""Store of results: .npy files in a folder, which several machines may mount, or at an address.

A file is one record, which `numpy.load` reads: its fields are the arrays of a result, after a field CRC32 with a
checksum of each, which covers the header, too.
"""

from __future__ import annotations

import ast
import contextlib
import errno
import io
import math
import os
import threading
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from ..system.addresses import Address, Place
from ..system.errors import ScratchError, reason_of
from ..system.output import write_atomically

#: Arrays of a result by name, empty or of any shape.
Arrays = Mapping[str, NDArray[Any]]

#: Suffix of result files: without it, no result could have the name of a folder of others.
SUFFIX = ".npy"

#: Field with the checksums of the other fields.
CRC32 = "crc32"

#: Bytes read for the header and the checksums, some 40 an array; and bytes of a piece of a result that is only checked.
READ_AHEAD, CHECK_BYTES = 1 << 16, 1 << 24

#: Most rows between requested rows that are read with them rather than skipped. Chosen: some 10 KB.
GAP = 128

#: Error numbers of a full disk or quota.
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}

_File = FileIO | BufferedReader


class DamagedError(ValueError):
    """A result file is damaged."""


#: Errors of a result that is missing or damaged.
MISSING = (FileNotFoundError, NotADirectoryError, DamagedError)


@dataclass(frozen=True)
class StoredArray:
    """Array of a result file.

    Attributes:
        offset: of the numbers in the file, bytes.
        begun: CRC-32 of the file's header.
        checksum: CRC-32 of the header and the numbers.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    begun: int
    checksum: int

    def check(self, pieces: Iterable[NDArray[Any]]) -> int:
        """Compare the numbers with the checksum, else raise `DamagedError`; return their size in bytes."""
        checksum, size = self.begun, 0
        for piece in pieces:
            checksum, size = zlib.crc32(_bytes(piece), checksum), size + piece.nbytes
        if checksum != self.checksum:
            raise DamagedError("its checksum does not match")
        return size


def encode(arrays: Arrays) -> Iterator[bytes | memoryview]:
    """Yield the bytes of a result in pieces; C-contiguous arrays are not copied."""
    header = io.BytesIO()
    fields = [(CRC32, "<u4", (len(arrays),)), *((name, each.dtype.str, each.shape) for name, each in arrays.items())]
    npy_format.write_array_header_2_0(header, {"descr": fields, "fortran_order": False, "shape": ()})
    begun = zlib.crc32(header.getvalue())
    checksums = np.array([zlib.crc32(_bytes(array), begun) for array in arrays.values()], "<u4")
    yield header.getvalue() + checksums.tobytes()
    yield from map(_bytes, arrays.values())


def read_directory(file: _File, size: int) -> dict[str, StoredArray]:
    """Read the names and layouts of the arrays of a result from a file of `size` bytes.

    Raises:
        DamagedError: the file is cut short, or not a result.
    """
    head = _filled(file, 0, np.empty(min(size, READ_AHEAD), np.uint8)).tobytes()
    stream, arrays = io.BytesIO(head), {}
    try:
        npy_format.read_magic(stream)
        length = int.from_bytes(stream.read(4), "little")
        (_, _, (count,)), *fields = ast.literal_eval(stream.read(length).decode())["descr"]
        end, begun = stream.tell(), zlib.crc32(head[: stream.tell()])
        checksums = np.frombuffer(head, "<u4", count, end)
        end += checksums.nbytes
        for (name, dtype, shape), checksum in zip(fields, checksums.tolist(), strict=True):
            arrays[name] = StoredArray(np.dtype(dtype), shape, end, begun, checksum)
            end += math.prod(shape) * arrays[name].dtype.itemsize
    except Exception:  # parsers raise any error for damaged bytes
        raise DamagedError("its header is damaged or cut short") from None
    if end != size:
        raise DamagedError(f"it has {size:,} bytes of {end:,}")
    return arrays


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


class Store:
    """Results of tasks by name: files that appear whole or not at all, with arrays by key.

    A store can be pickled and used by several threads at once. Methods raise `ScratchError` if results cannot be read
    or written. Checksums reveal damage: `get` compares them, `rows` does not, and `is_sound` compares all of a result.

    Files are not synced, which would double the time of writing: written data survive the process, and checksums reveal
    the damage of a power failure.

    Attributes:
        folder: on this machine, mounted by several, or at an address; created with the first result.
        written, read: bytes, also those that `count_bytes` adds for other processes.
    """

    def __init__(self, folder: Place) -> None:
        self.folder = folder
        self.written = self.read = 0
        self._directories: dict[str, tuple[int, dict[str, StoredArray]]] = {}  # with the size of the file
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[Store], tuple[Place]]:
        return type(self), (self.folder,)

    def __str__(self) -> str:
        return str(self.folder)

    def count_bytes(self, *, written: int = 0, read: int = 0) -> None:
        """Add to the bytes written and read."""
        with self._lock:
            self.written += written
            self.read += read

    def names(self) -> list[str]:
        """Return the names of all results, in order."""
        folder = self.folder
        if isinstance(folder, Path):
            files = folder.rglob(f"*{SUFFIX}")
            return sorted(path.relative_to(folder).as_posix().removesuffix(SUFFIX) for path in files)
        with self._translated("read"):
            return [name.removesuffix(SUFFIX) for name in folder.files() if name.endswith(SUFFIX)]

    def _place(self, name: str) -> Place:
        return self.folder / f"{name}{SUFFIX}"

    def _open(self, name: str) -> _File:
        place = self._place(name)
        if isinstance(place, Path):
            return place.open("rb", buffering=0)
        size, _ = self._directories.get(name, (None, {}))
        return place.open(buffering=READ_AHEAD, size=size)

    def has(self, name: str) -> bool:
        """Return whether a result exists and, in a folder, is not cut short."""
        place = self._place(name)
        with self._translated("read"):
            if isinstance(place, Address):
                return place.is_file()
            with contextlib.suppress(*MISSING), self._open(name) as file:
                self._directory(name, file)
                return True
        return False

    def put(self, name: str, arrays: Arrays) -> None:
        """Write or replace a result of arrays of plain numbers; raise `TypeError` for others."""
        self._forget(name)
        for key, array in arrays.items():
            if array.dtype.kind not in "biufc":
                raise TypeError(f"{key} is an array of {array.dtype}; results have arrays of plain numbers")
        pieces = encode({key: np.ascontiguousarray(array).reshape(array.shape) for key, array in arrays.items()})
        place = self._place(name)
        with self._translated("write"):
            if isinstance(place, Address):
                size = place.write(pieces)
            else:
                place.parent.mkdir(parents=True, exist_ok=True)
                size = write_atomically(place, pieces, overwrite=True, sync=False)
        self.count_bytes(written=size)

    def get(self, name: str, keys: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
        """Read a result, or only arrays with these keys, and compare the checksums."""
        arrays = {}
        with self._reading(name) as (file, directory):
            for key in directory if keys is None else keys:
                stored = directory[key]
                arrays[key] = _filled(file, stored.offset, np.empty(stored.shape, stored.dtype))
                self.count_bytes(read=stored.check([arrays[key]]))
        return arrays

    def rows(self, name: str, key: str, start: int, stop: int) -> NDArray[Any]:
        """Read the rows of an array from `start` to `stop`, or to its end if that is less."""
        return self._runs(name, key, [start], [stop - start])

    def rows_at(self, name: str, key: str, index: NDArray[np.int64]) -> NDArray[Any]:
        """Read rows of an array by ascending numbers, at least one, each run with short gaps at once."""
        cuts = np.flatnonzero(np.diff(index) > GAP) + 1
        first = index[np.concatenate([[0], cuts])]
        count = index[np.concatenate([cuts, [len(index)]]) - 1] + 1 - first
        rows = self._runs(name, key, first.tolist(), count.tolist())
        if len(rows) == len(index):
            return rows
        in_cut = np.diff(np.concatenate([[0], cuts, [len(index)]]))
        return rows[index - np.repeat(first - (np.cumsum(count) - count), in_cut)]

    def _runs(self, name: str, key: str, first: Sequence[int], count: Sequence[int]) -> NDArray[Any]:
        """Read and concatenate runs of rows of an array, each by its first row and its length."""
        with self._reading(name) as (file, directory):
            stored = directory[key]
            row_bytes = math.prod(stored.shape[1:]) * stored.dtype.itemsize
            rows, at = np.empty((sum(count), *stored.shape[1:]), stored.dtype), 0
            for row, length in zip(first, count, strict=True):
                end = at + max(0, min(length, stored.shape[0] - row))
                _filled(file, stored.offset + row * row_bytes, rows[at:end])
                at = end
        self.count_bytes(read=rows[:at].nbytes)
        return rows[:at]

    def shape(self, name: str, key: str) -> tuple[int, ...]:
        with self._reading(name) as (_, directory):
            return directory[key].shape

    def remove(self, name: str) -> None:
        """Remove a result, if it exists."""
        self._forget(name)
        with self._translated("write"):
            self._place(name).unlink(missing_ok=True)

    def is_sound(self, name: str) -> bool:
        """Return whether a result exists and is undamaged, by reading all of it."""
        self._forget(name)
        with self._translated("read"), contextlib.suppress(*MISSING), self._open(name) as file:
            for stored in self._directory(name, file).values():
                self.count_bytes(read=stored.check(_pieces(file, stored)))
            return True
        return False

    def _forget(self, name: str) -> None:
        with self._lock:
            self._directories.pop(name, None)

    def _directory(self, name: str, file: _File) -> dict[str, StoredArray]:
        """Return the directory of an open file, which is cached until the size of the file changes."""
        size = file.seek(0, os.SEEK_END)
        with self._lock:
            known, directory = self._directories.get(name, (None, {}))
        if known != size:
            directory = read_directory(file, size)
            with self._lock:
                self._directories[name] = size, directory
        return directory

    @contextlib.contextmanager
    def _reading(self, name: str) -> Iterator[tuple[_File, dict[str, StoredArray]]]:
        with self._translated("read"):
            try:
                with self._open(name) as file:
                    yield file, self._directory(name, file)
            except DamagedError as error:
                raise ScratchError(
                    f"{name} in the scratch folder {self.folder} is damaged: {error}; run the command again with"
                    " --resume, which makes it again"
                ) from None
            except (FileNotFoundError, NotADirectoryError):
                raise ScratchError(
                    f"{name} is missing in the scratch folder {self.folder}: somebody removed it; begin anew with"
                    " --overwrite, without --resume"
                ) from None

    @contextlib.contextmanager
    def _translated(self, action: str) -> Iterator[None]:
        """Translate an `OSError` into a `ScratchError`."""
        try:
            yield
        except OSError as error:
            reason = reason_of(error)
            if error.errno in FULL:
                raise ScratchError(
                    f"there is no room left in the scratch folder {self.folder}: {reason}; free some and run the"
                    " command again with --resume, or choose another disk with --scratch-dir"
                ) from None
            raise ScratchError(
                f"cannot {action} in the scratch folder {self.folder}: {reason}; choose another one with --scratch-dir"
            ) from None


def _filled(file: _File, offset: int, array: NDArray[Any]) -> NDArray[Any]:
    """Fill an array with the bytes of a file from `offset` on; raise `DamagedError` if the file ends before."""
    view = _bytes(array)
    file.seek(offset)
    while view:
        count = file.readinto(view)
        if not count:
            raise DamagedError("it is cut short")
        view = view[count:]
    return array


def _pieces(file: _File, stored: StoredArray) -> Iterator[NDArray[Any]]:
    size = math.prod(stored.shape) * stored.dtype.itemsize
    for start in range(0, size, CHECK_BYTES):
        piece = np.empty(min(CHECK_BYTES, size - start), np.uint8)
        yield _filled(file, stored.offset + start, piece)
