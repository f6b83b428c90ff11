"""Writes the files of one output, a header and those that it names, so that all of them appear or none does."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ..support import atomic, atomic_set
from ..support.addresses import Address, Place
from ..support.errors import OutputError
from ..support.stdin import DASH
from .names import number_of, reason_of
from .uploads import check_together, upload_together
from .writing import check_writable

#: The name and content of each file; the header comes last.
Files = Iterable[tuple[str, Iterable[bytes]]]

#: Writes the files of an output and returns how many bytes it wrote.
SinkTogether = Callable[[Files], int]


def chunk_files(path: Path) -> list[Path]:
    """The files beside a header that are called as those that it names would be, whether it names them or not.

    Args:
        path: of a header, which need not exist: the meta.json of a SOG, or a RAD.
    """
    target = Path(os.path.realpath(path))
    try:
        found = {number_of(each.name, target.name): each for each in target.parent.iterdir()}
    except OSError:
        return []
    return [found[number] for number in sorted(number for number in found if number is not None)]


def write_together(path: Place, files: Files, *, overwrite: bool) -> int:
    """Writes a header and the files that it names, all or none of them, and returns their size; makes their folder.

    With `overwrite`, files of a larger output that was there before are removed. See `atomic_set.write` for what an
    interruption leaves.

    Args:
        path: of the header; where it is a symbolic link, all files go to where that leads.
        files: names in the folder of the header, and their content; the last is the header, whose name is that of
            `path`.
        overwrite: replace existing files.

    Raises:
        OutputError: a file exists and `overwrite` is not set, or the file system refused something.
    """
    if isinstance(path, Address):
        return upload_together(path, files, overwrite=overwrite)
    _check(path, overwrite=overwrite)
    target = Path(os.path.realpath(path))
    placed = ((target.name if number_of(name, target.name) is None else name, pieces) for name, pieces in files)
    try:
        with atomic.created(target.parent):
            return atomic_set.write(
                target.parent,
                placed,
                overwrite=overwrite,
                outdated=lambda names: (each.name for each in chunk_files(target) if each.name not in names),
            )
    except FileExistsError as error:
        raise _taken(Path(error.filename or path)) from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def sink_together(path: Place, *, overwrite: bool) -> SinkTogether:
    """The function that writes a header and the files that it names. Fails now if they cannot be written later.

    Raises:
        OutputError: it is no place for several files, or see `check_writable`.
    """
    _check(path, overwrite=overwrite)
    return functools.partial(write_together, path, overwrite=overwrite)


def check_header(path: Place, *, overwrite: bool) -> None:
    """Raises `OutputError` where a file that names others cannot be written, before work goes into it."""
    if path == DASH:
        raise OutputError("standard output cannot take several files; name a file")
    check_writable(path, overwrite=overwrite)
    if path.exists() and not path.is_file():
        raise OutputError(f"{path} is a pipe or a device, which cannot take several files; name a file")


def _check(path: Place, *, overwrite: bool) -> None:
    if isinstance(path, Address):
        check_together(path, overwrite=overwrite)
        return
    check_header(path, overwrite=overwrite)
    for each in chunk_files(path):
        if not overwrite or _is_no_file(each):
            raise _taken(each)


def _taken(path: Path) -> OutputError:
    if _is_no_file(path):
        return OutputError(f"{path} is not a file; move it away, or name another output")
    return OutputError(f"{path} exists, add --overwrite to replace it")


def _is_no_file(path: Path) -> bool:
    return path.exists() and not path.is_file()
