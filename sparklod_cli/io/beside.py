"""Files that belong to another one: those that a splat file names beside itself, and those of a camera path."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO

from ..codecs.formats import HEAD
from ..codecs.rad import header as rad_header
from ..codecs.sog.files import MAX_META, names_beside
from ..codecs.sog.names import META
from ..support.addresses import Place
from ..support.errors import FormatError, UnreadableError
from ..support.stdin import DASH
from ..support.untrusted import quoted_value
from .names import leads_away, reason_of


def companions(path: Path, sets: Collection[Collection[str]]) -> list[Path]:
    """The files that are read together with one, as far as can be told; nothing is raised.

    Args:
        path: of a file, or of a folder.
        sets: as for `read_together`.
    """
    try:
        folder = path if path.is_dir() else path.parent
        meta = folder / META if path.is_dir() else path
        if path.is_dir():
            names = [META, *itertools.chain(*sets)]
        else:
            names = list(itertools.chain(*(names for names in sets if path.name in names)))
        if meta.is_file():
            names += _named_in(meta)
        beside = [folder / name for name in names if not leads_away(name)]
        return [file for file in beside if file.is_file()]
    except (OSError, ValueError, FormatError):
        return []


def _named_in(path: Path) -> list[str]:
    """The names of files that a splat file refers to: images of an unpacked SOG, chunks of a RAD."""
    with path.open("rb") as file:
        head = file.read(HEAD)
        file.seek(0)
        if head.startswith(rad_header.MAGIC):
            return list(rad_header.read_header(file).filenames)
        if head.lstrip().startswith(b"{") and path.stat().st_size <= MAX_META:
            return names_beside(file.read())
    return []


def in_folder(folder: Place) -> Place:
    """The splat file that a folder stands for; `UnreadableError` where it holds no unpacked SOG."""
    path = folder / META
    if not path.is_file():
        raise UnreadableError("cannot be read: is a directory, without the meta.json of an unpacked SOG")
    return path


def path_beside(first: Path, name: str) -> Path:
    """Where a file would be that another one names; `FormatError` where the name could lead out of their folder."""
    _check_name(name)
    return first.parent / name


def open_beside(first: Place, name: str) -> BinaryIO:
    """Opens a file that another one names; `FormatError` where the name could lead out of their folder."""
    if first == DASH:
        raise FormatError(f"it names {quoted_value(name)}, but standard input has no folder; give the path instead")
    _check_name(name)
    path = first.parent / name
    try:
        if path.exists() and not path.is_file():
            raise FormatError(f"{quoted_value(name)}, which it names, is not a file")
        return path.open("rb")
    except OSError as error:
        raise FormatError(f"{quoted_value(name)}, which it names, cannot be read: {reason_of(error)}") from None


def _check_name(name: str) -> None:
    if leads_away(name):
        raise FormatError(f"it names {quoted_value(name)}, which is not a file beside it")
