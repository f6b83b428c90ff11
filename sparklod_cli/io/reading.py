"""Splat files of any format, which their content tells, and small files that are read whole."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ..codecs import rgba
from ..codecs.encoder import Stored
from ..codecs.formats import FORMATS, NPZ, RAW_SUFFIXES, Format, head_of, sniff
from ..codecs.lookalikes import POINTER, SHORT, is_pointer, lookalike_of
from ..codecs.reader import OpenCompanion
from ..codecs.zip_folder import ZIP, ZipFolder
from ..model.scene import DetailScene
from ..model.splats import FloatArray
from ..model.tile_scene import TileScene
from ..system.addresses import Place, size_of
from ..system.errors import FormatError, UnknownFormatError, UnreadableError
from ..system.progress import Progress, silent
from ..system.stdio import DASH, spooled
from ..system.untrusted import decoded_text
from .local_files import in_folder, open_named, reason_unreadable

if TYPE_CHECKING:
    from ..codecs.gpu import dump


def read_stored(path: Place) -> Stored:
    """Return the codes of a Level-of-Detail file, so that its leaves can be written again bit for bit.

    Args:
        path: of a file whose format can be written with a tree; - is standard input.

    Raises:
        FormatError: as `read_scene`.
    """
    with opened(path) as (file, form, more):
        found: Stored = form.codec().stored(file, **more)
    return found


def read_parts(path: Place, *, threads: int = 1, progress: Progress = silent) -> DetailScene | TileScene | None:
    """Read a scene with all its detail levels or tiles; None where its format has neither.

    Args:
        path: of the lod-meta.json of a Streamed SOG, of the tileset.json of 3D Tiles, or of the folder that holds it.

    Raises:
        FormatError: as `read_scene`.
    """
    with opened(path) as (file, form, more):
        if form.parts is None:
            return None
        scene: DetailScene | TileScene = form.codec().decode_parts(file, threads=threads, progress=progress, **more)
    return scene


@contextlib.contextmanager
def opened(path: Place) -> Iterator[tuple[BinaryIO, Format, dict[str, Any]]]:
    """Yield a splat file of any known format, the format, and what else its codec takes.

    Raises:
        FormatError: it is not a file, empty, or of no known format; an `OSError` of the body becomes one.
    """
    with readable(), contextlib.ExitStack() as closing:
        yield open_splats(path, closing)


def open_splats(path: Place, closing: contextlib.ExitStack) -> tuple[BinaryIO, Format, dict[str, Any]]:
    """As `opened`, until `closing` closes the file; an `OSError` is raised as it is."""
    if path.is_dir():
        path = in_folder(path)
    if path != DASH and path.exists() and not path.is_file():
        raise UnreadableError(
            "it is a pipe or a device; save it to a file, or give - to build-lod, simplify or inspect: - reads"
            " standard input"
        )
    file = closing.enter_context(file_of(path))
    head = head_of(file)
    form = recognised(head, path)
    open_companion: OpenCompanion = functools.partial(open_named, path, folders=form.folders)
    if head.startswith(ZIP) and form.companions:
        folder = ZipFolder(file)
        file.seek(0)
        if folder.first != form.unbundled:  # a folder of another format in a zip
            file, open_companion = folder.open(folder.first), folder.open
            form = recognised(head_of(file), Path(folder.first))
    return file, form, {"open_companion": open_companion} if form.companions else {}


def recognised(head: bytes, path: Place) -> Format:
    """Return the format of a file by its first bytes, see `head_of`, or else by its suffix.

    Raises:
        FormatError: it is empty, or of no known format.
    """
    if not head:
        raise UnreadableError("the file is empty")
    form = sniff(head, path.suffix)
    if form is None:
        lookalike = lookalike_of(head)
        if lookalike is not None:
            raise UnknownFormatError(f"not a splat file, but {lookalike}")
        names = ", ".join(form.name for form in FORMATS)
        unmarked = " or ".join(ending for each in FORMATS if each.unmarked for ending in each.suffixes)
        hint = f"; {unmarked} is not recognised by its content: pass it as a file" if path == DASH else ""
        if path.suffix.lower() in RAW_SUFFIXES:
            hint = "; words alone, as --encoding writes them by this suffix, do not tell what they are"
        raise UnknownFormatError(f"not a splat file that sparklod reads ({names}){hint}")
    if head.startswith(ZIP) and path.suffix.lower() == NPZ:
        raise UnknownFormatError(
            "it holds arrays for a viewer and no scene; use the file that they were made of, or unpack them in Python"
        )
    return form


@contextlib.contextmanager
def readable() -> Iterator[None]:
    """Turn an `OSError` of the body, which reads a file, into an `UnreadableError`."""
    try:
        yield
    except OSError as error:
        raise UnreadableError(f"cannot be read: {reason_unreadable(error)}") from None


def read_arrays(path: Path) -> dump.Arrays | None:
    """Return the arrays of a .npz file; None where a file is something else, or cannot be opened.

    Raises:
        FormatError: an array is damaged, or of no plain numbers.
    """
    from ..codecs.gpu import dump

    try:
        if path != DASH and not path.is_file():
            return None
        with file_of(path) as file:
            if file.read(len(ZIP)) != ZIP:
                return None
            return dump.decode_npz(file)
    except (OSError, UnreadableError):
        return None


def file_of(path: Place) -> contextlib.AbstractContextManager[BinaryIO]:
    """Return a file that is closed at the end, or standard input, which is not."""
    return contextlib.nullcontext(spooled()) if path == DASH else path.open("rb")


def size_of_input(path: Place) -> int | None:
    """Return bytes of a file, or of standard input; None where that cannot be told."""
    try:
        if path == DASH:
            return spooled().seek(0, os.SEEK_END)
        return size_of(path) if path.is_file() else None
    except UnreadableError:
        return None
    except OSError:
        return None


#: Bytes of a text that is read whole: instances, expectations, matrices. Parsed it may take thirty times as much.
MAX_TEXT = 1 << 24


def read_text(path: Path) -> str:
    """Return a text file of at most `MAX_TEXT` bytes; `UnreadableError`, naming it, where that cannot be."""
    try:
        return decoded_text(_read_up_to(path, MAX_TEXT))
    except (OSError, ValueError) as error:
        reason = reason_unreadable(error) if isinstance(error, OSError) else "it is not text"
        raise UnreadableError(f"{path} cannot be read: {reason}") from None


def read_together(path: Path, sets: Collection[Collection[str]], limit: int) -> dict[str, bytes]:
    """Return files that belong together, by name, the one that `path` names first.

    Args:
        path: of a file, or of a folder that holds one of the sets.
        sets: names of files that belong together; where `path` is one of a set, the others beside it are read, too.

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
    """Return colours and opacities for the `count` splats of a scene, or for a range of them, see `rgba.decode`.

    Raises:
        FormatError: it cannot be read or is not such a file; names it.
    """
    try:
        if path.exists() and not path.is_file():
            raise FormatError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            if is_pointer(file.read(SHORT)):
                raise FormatError(f"cannot be read: it is {POINTER}")
            file.seek(0)
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
    data = path.read_bytes()
    if is_pointer(data):
        raise UnreadableError(f"{path} cannot be read: it is {POINTER}")
    return data
