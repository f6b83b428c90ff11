"""Zips that hold the files of one scene, as the folder that they are."""

from __future__ import annotations

import contextlib
import io
import struct
import threading
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import IO, BinaryIO

from ..system.errors import ChecksumError, FormatError, NotSplatsError
from ..system.untrusted import quoted, quoted_value
from .compression import check_promise
from .formats import MANIFEST, META, TILESET
from .reader import size_of

#: What `zipfile` raises on archives that are damaged, encrypted or of a kind that it does not read.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)

#: Compression methods that are read, and the flag of an encrypted member.
METHODS, ENCRYPTED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), 1

#: Bytes that are read at a time.
PIECE = 1 << 20

#: Members that a message names.
FEW = 3


class ZipFolder:
    """Zip of the files of a scene, possibly inside a folder.

    `first` is the name of the file that names the others, such as meta.json; their names are relative to it.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._size, self._lock = size_of(file), threading.Lock()
        try:
            self._zip = zipfile.ZipFile(file)
        except ZIP_ERRORS as error:
            raise FormatError(f"not a complete zip archive: {quoted(error)}") from None
        files = [each for each in self._zip.infolist() if not each.is_dir()]
        # Windows PowerShell writes backslashes, and some programs "./" before names.
        self._members = {str(PurePosixPath(each.filename.replace("\\", "/"))): each for each in files}
        path = _first_file(list(self._members))
        self.first = PurePosixPath(path).name
        self._folder = path.removesuffix(self.first)

    def _member(self, name: str) -> zipfile.ZipInfo:
        try:
            return self._members[self._folder + name]
        except KeyError:
            raise FormatError(f"{self.first} names {quoted_value(name)}, which is not in the archive") from None

    def bytes_of(self, name: str) -> int:
        """Return the bytes of a member as it is stored."""
        return self._member(name).compress_size

    def open(self, name: str) -> BinaryIO:
        """Return the content of a member as a file."""
        with self.opened(name) as file:
            return io.BytesIO(b"".join(iter(lambda: file.read(PIECE), b"")))

    @contextlib.contextmanager
    def opened(self, name: str, *, whole: bool = True) -> Iterator[IO[bytes]]:
        """Open a member, whose checksum is checked at the end, also if its content turns out to be corrupt.

        Args:
            whole: read the rest of it at the end; False if only its beginning is needed.
        """
        member = self._member(name)
        if member.compress_type not in METHODS or member.flag_bits & ENCRYPTED:
            raise FormatError(f"{quoted_value(name)} is encrypted, or compressed by a method that is not read")
        check_promise(member.file_size, self._size)
        try:
            with self._lock:
                opened = self._zip.open(member)
            with opened as file:
                try:
                    yield file
                finally:
                    while whole and file.read(PIECE):
                        pass
        except ZIP_ERRORS as error:
            kind = ChecksumError if "CRC" in str(error) else FormatError
            raise kind(f"{quoted_value(name)} cannot be unpacked: {quoted(error)}") from None


def _first_file(names: list[str]) -> str:
    """Return the name of the file that names the others.

    The metas of chunks and nested tilesets belong to the manifest above them.
    """
    above = {MANIFEST: (), META: (MANIFEST,), TILESET: (TILESET,)}
    paths = {path: name for name in names if (path := PurePosixPath(name)).name in above}
    found = [
        name
        for path, name in paths.items()
        if not any(folder / manifest in paths for folder in path.parent.parents for manifest in above[path.name])
    ]
    if len(found) == 1:
        return found[0]
    listed = ", ".join(quoted_value(name) for name in (found or names)[:FEW])
    listed += ", ..." if len(found or names) > FEW else ""
    if found:
        raise NotSplatsError(f"a zip archive of several scenes ({listed}): unzip it, and give one of them")
    raise NotSplatsError(
        f"a zip archive ({listed}) without {META}, {MANIFEST} or {TILESET}: unzip it, and give a splat file that was"
        " in it"
    )
