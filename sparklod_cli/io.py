"""The only module that opens paths: what a file is, scenes in, files out whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import sys
from collections.abc import Iterable
from pathlib import Path

from .codecs.formats import FORMATS, sniff
from .errors import FormatError, OutputError
from .progress import Progress, silent
from .scene import Scene


def read_scene(path: Path, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Reads a splat file of any known format, told by its content.

    Raises:
        FormatError: it is not a file, empty, of no known format, or broken.
    """
    try:
        if str(path) == "-":
            raise FormatError("standard input is not read; save it to a file first")
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise FormatError("it is a pipe or a device; save it to a file first")
        with path.open("rb") as file:
            head = file.read(16)
            file.seek(0)
            if not head:
                raise FormatError("the file is empty")
            form = sniff(head)
            if form is None:
                names = ", ".join(form.name for form in FORMATS)
                raise FormatError(f"not a splat file that sparklod reads ({names})")
            scene: Scene = form.codec().decode(file, threads=threads, progress=progress)
            return scene
    except OSError as error:
        raise FormatError(f"cannot be read: {_reason(error)}") from None


def check_writable(path: Path, *, overwrite: bool, make_parent: bool = False) -> None:
    """Raises `OutputError` where an output cannot be written, before work goes into it.

    Args:
        path: of the output.
        overwrite: an existing file may be replaced.
        make_parent: make its directory if there is none.
    """
    if make_parent:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make {path.parent}: {_reason(error)}") from None
    try:
        if path.is_dir():
            raise OutputError(f"{path} is a directory")
        if path.is_file() and not overwrite:
            raise OutputError(f"{path} exists, add --overwrite to replace it")
        if not path.parent.is_dir():
            raise OutputError(f"the directory {path.parent} does not exist")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {_reason(error)}") from None


def write_whole(path: Path, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Writes a file so that it appears complete or not at all, and returns its size.

    A temporary file beside it is filled, synced and renamed; an interruption leaves nothing behind.

    Raises:
        OutputError: it exists and `overwrite` is not set, or the file system refused something.
    """
    check_writable(path, overwrite=overwrite)
    try:
        if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
            with path.open("wb") as file:
                return sum(map(file.write, pieces))
        return _write_and_rename(Path(os.path.realpath(path)), pieces, overwrite)
    except FileExistsError:
        raise OutputError(f"{path} exists, add --overwrite to replace it") from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {_reason(error)}") from None


def _write_and_rename(target: Path, pieces: Iterable[bytes], overwrite: bool) -> int:
    temporary = target.with_name(f".sparklod-{secrets.token_hex(8)}.part")
    try:
        with temporary.open("xb") as file:
            size = sum(map(file.write, pieces))
            file.flush()
            os.fsync(file.fileno())
        _publish(temporary, target, overwrite)
    finally:
        temporary.unlink(missing_ok=True)
    return size


def _publish(temporary: Path, target: Path, overwrite: bool) -> None:
    """Gives a complete file its name; `FileExistsError` where somebody took that meanwhile."""
    if overwrite:
        with contextlib.suppress(FileNotFoundError):
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))  # what was private stays private
        temporary.replace(target)
        return
    try:
        os.link(temporary, target)  # fails where the name is taken; a rename would replace it
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if target.exists():
            raise FileExistsError from None
        temporary.replace(target)


def write_stdout(pieces: Iterable[bytes]) -> int:
    """Writes to standard output and returns how many bytes; raises `OutputError` where nobody reads them."""
    if sys.stdout is None:
        raise OutputError("standard output is closed")
    try:
        size = sum(map(sys.stdout.buffer.write, pieces))
        sys.stdout.buffer.flush()
    except OSError as error:
        raise OutputError(f"cannot write standard output: {_reason(error)}") from None
    return size


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
