"""Reads small files whole: texts, cameras, colours."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ..codecs import rgba
from ..model.splats import FloatArray
from ..support.errors import FormatError, UnreadableError
from .names import reason_unreadable

#: Bytes of a text that is read whole: instances, expectations, matrices. Parsed it may take thirty times as much.
MAX_TEXT = 1 << 24


def read_text(path: Path) -> str:
    """A text file of at most `MAX_TEXT` bytes; `UnreadableError`, naming it, where that cannot be."""
    try:
        return str(_read_up_to(path, MAX_TEXT), "utf-8-sig")
    except (OSError, ValueError) as error:
        reason = reason_unreadable(error) if isinstance(error, OSError) else "it is not text"
        raise UnreadableError(f"{path} cannot be read: {reason}") from None


def read_together(path: Path, sets: Collection[Collection[str]], limit: int) -> dict[str, bytes]:
    """Files that belong together, by name, the one that `path` names first.

    Args:
        path: of a file, or of a folder that holds one of the sets.
        sets: names of files that belong together; where `path` is one of a set, the others beside it are read, too.
        limit: bytes that a file may have.

    Raises:
        UnreadableError: there is no such file or set, or one is too large; the text names it.
    """
    try:
        if path.is_dir():
            folder = path
            names = next((names for names in sets if all((folder / name).is_file() for name in names)), None)
            if names is None:
                known = ", or ".join(" and ".join(names) for names in sets)
                raise UnreadableError(f"{path} cannot be read: is a directory, without {known}")
        else:
            folder = path.parent
            others = next((names for names in sets if path.name in names), ())
            names = [path.name, *(name for name in others if name != path.name and (folder / name).is_file())]
        return {name: _read_up_to(folder / name, limit) for name in names}
    except OSError as error:
        raise UnreadableError(f"{path} cannot be read: {reason_unreadable(error)}") from None


def read_rgba(path: Path, count: int, rows: slice | None = None) -> FloatArray:
    """Colours and opacities for the `count` splats of a scene, or for a range of them, see `rgba.decode`.

    Raises:
        FormatError: it cannot be read or is not such a file; names it.
    """
    try:
        if path.exists() and not path.is_file():
            raise FormatError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            return rgba.decode(file, count, rows)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {reason_unreadable(error)}") from None
    except FormatError as error:
        raise type(error)(f"{path} {error}") from None


def _read_up_to(path: Path, limit: int) -> bytes:
    if path.is_dir():
        raise UnreadableError(f"{path} cannot be read: is a directory")
    if path.exists() and not path.is_file():
        raise UnreadableError(f"{path} cannot be read: it is a pipe or a device; save it to a file first")
    if path.stat().st_size > limit:
        raise UnreadableError(f"{path} is larger than {limit >> 20:,} MiB, which nothing of its kind is")
    return path.read_bytes()
