"""A store of results in a folder of this machine, or one that several machines mount."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections.abc import Collection, Iterator
from io import FileIO
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ...support import atomic
from ...support.errors import ScratchError
from .contracts import Arrays, Traffic
from .results import HEAD, DamagedError, Entry, Table, check, decode_table, encode, table_bytes

#: Suffix of the files of results, so that a result may have the name of a folder of others.
SUFFIX = ".result"

#: Bytes that are read at once of a result that is only checked.
CHECK_BYTES = 1 << 24

#: What the system says of a disk, or a share of one, that is full.
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}


class FolderStore:
    """A folder with a file for each result.

    Files are not synced, which would take half of the time of writing: what a process has written is there when the
    process is killed, and a checksum of each array, in its file, tells what a power failure damaged. `get` compares it,
    `rows` does not; `is_sound` reads all of a result for that, as a bake does that resumes.

    Attributes:
        folder: of the files; made when the first result is put.
        traffic: what was written and read by this process.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.traffic = Traffic()
        self._tables: dict[str, Table] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[FolderStore], tuple[Path]]:
        return FolderStore, (self.folder,)

    def has(self, name: str) -> bool:
        """Whether there is a result of the length that it was written with."""
        try:
            with self._path(name).open("rb", buffering=0) as file:
                self._table(name, file)
        except (FileNotFoundError, NotADirectoryError, DamagedError):
            return False
        except OSError as error:
            self._refused("read", error)
        return True

    def put(self, name: str, arrays: Arrays) -> None:
        """Writes a result; replaces one of this name."""
        path = self._path(name)
        self._forget(name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.traffic.add(written=atomic.write(path, encode(arrays), overwrite=True, sync=False))
        except OSError as error:
            self._refused("write", error)

    def get(self, name: str, keys: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
        """Reads a result, or some of its arrays, and compares their checksums."""
        found = {}
        with self._reading(name) as (file, table):
            for key in table.entries if keys is None else keys:
                entry = table.entries[key]
                found[key] = _filled(file, entry.offset, np.empty(entry.shape, entry.dtype))
                check(entry, [found[key]])
                self.traffic.add(read=entry.bytes)
        return found

    def rows(self, name: str, key: str, start: int, stop: int) -> NDArray[Any]:
        """Reads rows of an array and nothing else."""
        with self._reading(name) as (file, table):
            entry = table.entries[key]
            start, stop, _ = slice(start, stop).indices(entry.shape[0])
            rows = np.empty((max(0, stop - start), *entry.shape[1:]), entry.dtype)
            _filled(file, entry.offset + start * entry.row_bytes, rows)
        self.traffic.add(read=rows.nbytes)
        return rows

    def shape(self, name: str, key: str) -> tuple[int, ...]:
        """The shape of an array."""
        with self._reading(name) as (_, table):
            return table.entries[key].shape

    def remove(self, name: str) -> None:
        """Removes a result, if it is there."""
        self._forget(name)
        try:
            self._path(name).unlink(missing_ok=True)
        except OSError as error:
            self._refused("write", error)

    def names(self) -> list[str]:
        """The names of all results, in order."""
        files = self.folder.rglob(f"*{SUFFIX}")
        return sorted(path.relative_to(self.folder).as_posix().removesuffix(SUFFIX) for path in files)

    def is_sound(self, name: str) -> bool:
        """Whether a result is there, and has the bytes that were put; reads all of it."""
        self._forget(name)
        if not self.has(name):
            return False
        try:
            with self._path(name).open("rb", buffering=0) as file:
                for entry in self._table(name, file).entries.values():
                    check(entry, _pieces(file, entry))
                    self.traffic.add(read=entry.bytes)
        except (FileNotFoundError, DamagedError):
            return False
        except OSError as error:
            self._refused("read", error)
        return True

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}{SUFFIX}"

    def _forget(self, name: str) -> None:
        with self._lock:
            self._tables.pop(name, None)

    def _table(self, name: str, file: FileIO) -> Table:
        """The table of a file that is open, which is read once."""
        size = os.fstat(file.fileno()).st_size
        with self._lock:
            table = self._tables.get(name)
        if table is None or table.bytes != size:
            head = file.read(HEAD.size)
            table = decode_table(head, file.read(table_bytes(head)), size)
            with self._lock:
                self._tables[name] = table
        return table

    @contextlib.contextmanager
    def _reading(self, name: str) -> Iterator[tuple[FileIO, Table]]:
        """The file of a result, and its table."""
        try:
            with self._path(name).open("rb", buffering=0) as file:
                yield file, self._table(name, file)
        except DamagedError as error:
            raise ScratchError(
                f"{name} in the scratch folder {self.folder} is damaged: {error}; run it again with --resume, which"
                " makes it anew"
            ) from None
        except OSError as error:
            self._refused("read", error)

    def _refused(self, what: str, error: OSError) -> NoReturn:
        reason = (error.strerror or str(error)).lower()
        if error.errno in FULL:
            raise ScratchError(
                f"there is no room left in the scratch folder {self.folder}: {reason}; free some and run it again with"
                " --resume, or choose another disk with --scratch-dir"
            ) from None
        raise ScratchError(
            f"cannot {what} in the scratch folder {self.folder}: {reason}; choose another one with --scratch-dir"
        ) from None


def _filled(file: FileIO, offset: int, array: NDArray[Any]) -> NDArray[Any]:
    """An array with the bytes of a file."""
    view = array.reshape(-1).view(np.uint8).data
    file.seek(offset)
    while view:
        count = file.readinto(view)
        if not count:
            raise DamagedError("it is cut short")
        view = view[count:]
    return array


def _pieces(file: FileIO, entry: Entry) -> Iterator[NDArray[Any]]:
    """The bytes of an array, some at a time."""
    for start in range(0, entry.bytes, CHECK_BYTES):
        piece = np.empty(min(CHECK_BYTES, entry.bytes - start), np.uint8)
        yield _filled(file, entry.offset + start, piece)
