"""Writes files whole or not at all, and standard output."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from ..support import atomic
from ..support.addresses import Address, Place
from ..support.errors import OutputError, StdoutError
from ..support.stdin import DASH
from ..support.stdout import ReaderGoneError, guarded
from .names import reason_of
from .uploads import check_address, upload

#: Writes the pieces of an output and returns how many bytes it wrote.
Sink = Callable[[Iterable[bytes]], int]


def check_writable(path: Place, *, overwrite: bool) -> None:
    """Raises `OutputError` where an output cannot be written, before work goes into it.

    Folders on the way to it that do not exist are no error: `write_whole` makes them.

    Args:
        path: of the output.
        overwrite: an existing file may be replaced.
    """
    if isinstance(path, Address):
        check_address(path, overwrite=overwrite)
        return
    try:
        if path.is_dir():
            raise OutputError(f"{path} is a directory")
        if path.is_file() and not overwrite:
            raise OutputError(f"{path} exists, add --overwrite to replace it")
        path.exists()  # raises where its name is too long
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        if not nearest.is_dir():
            raise OutputError(f"cannot write {path}: {nearest} is a file, not a folder")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def write_whole(path: Place, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Writes a file so that it appears complete or not at all, and returns its size; makes its folder if need be.

    It gets its name when it is filled and synced, see `whole`; an interruption leaves nothing behind.

    Raises:
        OutputError: it exists and `overwrite` is not set, or the file system refused something.
    """
    if isinstance(path, Address):
        return upload(path, pieces, overwrite=overwrite)
    check_writable(path, overwrite=overwrite)
    try:
        if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
            with path.open("wb") as file:
                return sum(map(file.write, pieces))
        target = Path(os.path.realpath(path))
        with atomic.created(target.parent):
            return atomic.write(target, pieces, overwrite=overwrite)
    except FileExistsError:
        raise OutputError(f"{path} exists, add --overwrite to replace it") from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def sink(path: Place, *, overwrite: bool) -> Sink:
    """The function that writes an output; - is standard output. Fails now if the output cannot be written later.

    Raises:
        OutputError: see `check_writable`.
    """
    if path == DASH:
        return write_stdout
    check_writable(path, overwrite=overwrite)
    return functools.partial(write_whole, path, overwrite=overwrite)


def write_stdout(pieces: Iterable[bytes]) -> int:
    """Writes to standard output and returns the number of bytes; raises `StdoutError` if they cannot be written."""
    size = 0
    with guarded():
        try:
            for piece in pieces:
                size += sys.stdout.buffer.write(piece)
            sys.stdout.buffer.flush()
        except ReaderGoneError as error:
            raise StdoutError(str(error)) from None
    return size
