"""Opens files of any format, which is recognised by content, and explains why one cannot be read."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from ..codecs.formats import FORMATS, RAW_SUFFIXES, ZIP, Format, head_of, lookalike_of, sniff
from ..codecs.reader import OpenCompanion, OpenFile, Scratch
from ..system.addresses import Place
from ..system.errors import FormatError, UnknownFormatError, UnreadableError
from ..system.stdio import DASH, spooled
from .local_files import in_folder, open_named, reason_unreadable

if TYPE_CHECKING:
    from ..codecs import array_files


@contextlib.contextmanager
def opened(path: Place, threads: int = 1) -> Iterator[tuple[OpenFile, Format]]:
    """Yield a splat file of any known format, and the format.

    Raises:
        FormatError: it is not a file, empty, or of no known format; an `OSError` of the body becomes one.
    """
    with readable(), contextlib.ExitStack() as closing:
        yield open_splats(path, closing, threads=threads)


def open_splats(
    path: Place, closing: contextlib.ExitStack, scratch: Scratch | None = None, threads: int = 1
) -> tuple[OpenFile, Format]:
    """As `opened`, until `closing` closes the file; an `OSError` is raised as it is."""
    if path.is_dir():
        path = in_folder(path)
    if path != DASH and path.exists() and not path.is_file():
        raise UnreadableError(
            "it is a pipe or a device; save it to a file, or give - to build-lod, simplify or inspect: - reads"
            " standard input"
        )
    file = spooled() if path == DASH else closing.enter_context(path.open("rb"))
    head = head_of(file)
    form = sniff(head, path.suffix)
    if form is None:
        raise unknown_format(head, path)
    open_companion: OpenCompanion = functools.partial(open_named, path, folders=form.folders)
    if head.startswith(ZIP) and form.companions:
        from ..codecs.zip_folder import ZipFolder  # what most files do without

        folder = ZipFolder(file)
        file.seek(0)
        if folder.first != form.unbundled:  # a folder of another format in a zip
            file, open_companion, path = folder.open(folder.first), folder.open, Path(folder.first)
            form = sniff(head := head_of(file), path.suffix)
            if form is None:
                raise unknown_format(head, path)
    return OpenFile(file, open_companion if form.companions else None, scratch, threads), form


def unknown_format(head: bytes, path: Place) -> FormatError:
    """Return the error for a file whose format `sniff` does not know."""
    if not head:
        return UnreadableError("the file is empty")
    if head.startswith(ZIP):
        return UnknownFormatError(
            "it holds arrays for a viewer and no scene; use the file that they were made of, or unpack them in Python"
        )
    lookalike = lookalike_of(head)
    if lookalike is not None:
        return UnknownFormatError(f"not a splat file, but {lookalike}")
    names = ", ".join(form.name for form in FORMATS)
    unmarked = " or ".join(ending for each in FORMATS if each.unmarked for ending in each.suffixes)
    hint = f"; {unmarked} is not recognised by its content: pass it as a file" if path == DASH else ""
    if path.suffix.lower() in RAW_SUFFIXES:
        hint = "; a file with this suffix has only words, as convert --layout writes them, without a header"
    return UnknownFormatError(f"not a splat file that sparklod reads ({names}){hint}")


@contextlib.contextmanager
def readable() -> Iterator[None]:
    """Turn an `OSError` of the body, which reads a file, into an `UnreadableError`."""
    try:
        yield
    except OSError as error:
        raise UnreadableError(f"cannot be read: {reason_unreadable(error)}") from None


def read_arrays(path: Path) -> array_files.Arrays | None:
    """Return the arrays of a .npz file; None if a file has another format, or cannot be opened."""
    from ..codecs import array_files

    try:
        if path != DASH and not path.is_file():
            return None
        with file_of(path) as file:
            if file.read(len(ZIP)) != ZIP:
                return None
            return array_files.decode_npz(file)
    except (OSError, UnreadableError):
        return None


def file_of(path: Place) -> contextlib.AbstractContextManager[BinaryIO]:
    """Return a file that is closed at the end, or standard input, which is not."""
    return contextlib.nullcontext(spooled()) if path == DASH else path.open("rb")
