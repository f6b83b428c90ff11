"""Fingerprints of file contents, by which a bake resumes or is skipped."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from dataclasses import dataclass

from ..system.addresses import Address, Place
from ..system.stdio import DASH, name_of
from .local_files import companions
from .reading import file_of, readable

#: Places of a file that are looked at, and bytes at each: 4 MB of a large one, which takes milliseconds. Chosen.
PLACES, PLACE_BYTES = 64, 1 << 16

#: Bytes of a digest: enough that no two contents share one.
DIGEST_BYTES = 16

_READ_BYTES = 1 << 22


@dataclass(frozen=True)
class Identity:
    """A file as it was.

    Attributes:
        name: of it, for messages.
        bytes: that it had.
        modified: nanoseconds since 1970; 0 for standard input, and at an address.
        sample: a digest of bytes from all over it, or of what the server of an address tells of its version.
    """

    name: str
    bytes: int
    modified: int
    sample: str


def files_of(path: Place, sets: Collection[Collection[str]] = ()) -> list[Place]:
    """Return the file of a path and those that it names, or the files of an unpacked or a Streamed SOG.

    Args:
        path: of a file or a folder.
        sets: names of files that belong together where some are there, as for `read_together`.
    """
    if path == DASH or isinstance(path, Address):
        return [path]
    found = companions(path, sets)
    return [*found] if path.is_dir() else [path, *(file for file in found if file != path)]


def identity_of(path: Place) -> Identity:
    """Return what a file is like, without reading much of it; - is standard input.

    Raises:
        UnreadableError: it cannot be read.
    """
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    if isinstance(path, Address):
        with readable():
            digest.update(path.version().encode())
            return Identity(str(path), path.size(), 0, digest.hexdigest())
    with readable(), file_of(path) as file:
        size = file.seek(0, os.SEEK_END)
        last = max(0, size - PLACE_BYTES)
        for start in sorted({last * place // (PLACES - 1) for place in range(PLACES)}):
            file.seek(start)
            digest.update(file.read(PLACE_BYTES))
        modified = 0 if path == DASH else os.fstat(file.fileno()).st_mtime_ns
    return Identity(name_of(path), size, modified, digest.hexdigest())


def stamp_of(path: Place) -> str:
    """Return size and date of a file, or its version at an address, which change when it is written.

    Raises:
        UnreadableError: there is no such file.
    """
    with readable():
        if isinstance(path, Address):
            return path.version()
        found = path.stat()
        return f"{found.st_size} {found.st_mtime_ns}"


def content_of(path: Place) -> str:
    """Return a digest of all of a file; - is standard input. Some 0.5 GB a second.

    Raises:
        UnreadableError: it cannot be read.
    """
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    with readable(), file_of(path) as file:
        while piece := file.read(_READ_BYTES):
            digest.update(piece)
    return digest.hexdigest()
