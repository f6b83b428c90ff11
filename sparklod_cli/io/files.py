"""Input files: recognised by content, opened, with their companions; texts; and reasons why one cannot be read."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import os
import shlex
import stat
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, BinaryIO

from ..codecs.formats import (
    FIRST_FILES,
    FORMATS,
    MANIFEST,
    META,
    POINTER,
    RAW_SUFFIXES,
    SHORT,
    TILESET,
    ZIP,
    Format,
    head_of,
    is_pointer,
    lookalike_of,
    sniff,
)
from ..codecs.reader import OpenCompanion, OpenFile, Scratch
from ..model.splats import FloatArray
from ..system.addresses import Place, size_of
from ..system.errors import FormatError, UnknownFormatError, UnreadableError, reason_of
from ..system.stdio import DASH, spooled
from ..system.untrusted import decoded_text, near, quoted_value

if TYPE_CHECKING:
    from ..codecs import layouts
    from ..codecs.rad.rad_reader import RadReader

#: Names in a folder that are compared with a missing one (comparing more delays the error noticeably), and least
#: similarity of a suggested one, as `difflib` measures it: a letter or two differ, or the suffix.
MOST_NAMES, SIMILAR = 10_000, 0.75


def is_file_name(text: str) -> bool:
    """Return whether a text can be a file name, without the byte 0 or half of a surrogate pair."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def leads_away(name: str, *, folders: bool = False) -> bool:
    """Return whether a name in a file may lead out of its folder; without `folders`, also into a folder below it."""
    if folders and "/" in name:
        return any(leads_away(part) for part in name.split("/"))
    return name in ("", ".", "..") or any(mark in name for mark in "/\\:") or not is_file_name(name)


def reason_unreadable(error: OSError) -> str:
    """Return the system's reason why an input cannot be read; for a missing one, also suggest a similar name."""
    reason = reason_of(error)
    if not isinstance(error, FileNotFoundError) or not isinstance(error.filename, (str, PurePath)):
        return reason
    folder, name = Path(error.filename).parent, Path(error.filename).name
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in itertools.islice(entries, MOST_NAMES)]
    except OSError:
        return reason
    return reason + near(name, names, cutoff=SIMILAR, folder=folder)


#: Flags that open a file for reading, without following a link or waiting for the other end of a pipe.
_FLAGS = os.O_RDONLY
for _name in ("O_BINARY", "O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"):
    _FLAGS |= getattr(os, _name, 0)


def open_plain(path: Path) -> BinaryIO:
    """Open a plain file for reading.

    Args:
        path: absolute and without links, from `Path.resolve`.

    Raises:
        OSError: it is missing, or a folder, a pipe or a device, or it or a folder above has become a link.
    """
    file = os.fdopen(os.open(path, _FLAGS), "rb")
    try:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise OSError(f"{path} is not a plain file")
        # O_NOFOLLOW heeds only the last part of a path. Files are compared, too, as a link may come and go.
        if path.resolve() != path or not os.path.samestat(found, path.lstat()):
            raise OSError(f"{path} has become a link")
    except OSError:
        file.close()
        raise
    return file


@contextlib.contextmanager
def opened(path: Place, threads: int = 1) -> Iterator[tuple[OpenFile, Format]]:
    """Open a splat file, and recognise its format.

    Raises:
        FormatError: it is not a file, empty, or of no known format; or the body of the context raised an `OSError`.
    """
    with readable(), contextlib.ExitStack() as closing:
        yield open_splats(path, closing, threads=threads)


@contextlib.contextmanager
def reopened(path: Path, reader: RadReader) -> Iterator[RadReader]:
    """Open a RAD file again, whose header was read; several threads may do so at a time."""
    with opened(path) as (source, _):
        yield dataclasses.replace(reader, file=source.file, open_companion=source.open_companion)


def open_splats(
    path: Place, closing: contextlib.ExitStack, scratch: Scratch | None = None, threads: int = 1
) -> tuple[OpenFile, Format]:
    """Open a splat file until `closing` closes it, as `opened` does, but leave an `OSError` unchanged."""
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
        from ..codecs.merging import ZipFolder  # what most files do without

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
    """Translate an `OSError` raised by reading a file into an `UnreadableError`."""
    try:
        yield
    except OSError as error:
        raise UnreadableError(f"cannot be read: {reason_unreadable(error)}") from None


def read_arrays(path: Path) -> layouts.Arrays | None:
    """Read the arrays of a .npz file; return None for a file of another format, or one that cannot be opened."""
    from ..codecs import layouts

    try:
        if path == DASH or path.is_file():
            with file_of(path) as file:
                return layouts.decode_npz(file) if file.read(len(ZIP)) == ZIP else None
    except (OSError, UnreadableError):
        pass
    return None


def file_of(path: Place) -> contextlib.AbstractContextManager[BinaryIO]:
    """Open a file, which the context closes; standard input stays open."""
    return contextlib.nullcontext(spooled()) if path == DASH else path.open("rb")


def companions(path: Path, sets: Collection[Collection[str]]) -> list[Path]:
    """Return the existing files that are read together with a file or folder; none, without an error, if it is broken.

    Args:
        sets: names of files that belong together, as for `read_together`.
    """
    try:
        if path.is_dir():
            found = [path / name for name in FIRST_FILES if (path / name).is_file()][:1]
            files = [*found, *_beside(path / META, itertools.chain(*sets))]
        else:
            found = [path] if path.is_file() else []
            files = _beside(path, itertools.chain(*(names for names in sets if path.name in names)))
        for first in found:
            files += _named_in(first)
        return [file for file in dict.fromkeys(files) if file.is_file()]
    except (OSError, ValueError, FormatError):
        return []


def _named_in(path: Path) -> list[Path]:
    """Return the files that a splat file names: images of a SOG, chunks of a RAD file, parts of the other formats."""
    with path.open("rb") as file:
        head = head_of(file)
        form = sniff(head, path.suffix)
        if form is not None and not form.companions:
            return []
        from ..codecs.gltf_container import GltfFile  # which most inputs do without, as what follows
        from ..codecs.rad import rad_header
        from ..codecs.streamed_manifest import MAX_MANIFEST, parse
        from ..codecs.tiles_3d import names_of
        from ..codecs.tileset import MAX_TILESET

        if head.startswith(rad_header.MAGIC):
            return _beside(path, rad_header.read_header(file).filenames)
        if form is not None and form.parts == "tiles":
            names = names_of(file.read(MAX_TILESET + 1), functools.partial(open_named, path, folders=True))
            return _beside(path, names, folders=True)
        if form is not None and form.name in ("GLB", "glTF"):
            return _beside(path, GltfFile(OpenFile(file)).names(), folders=True)
        if form is not None and form.folders:
            metas = _beside(path, parse(file.read(MAX_MANIFEST + 1)).names(), folders=True)
            return [*metas, *itertools.chain(*map(_images_of, metas))]
    return _images_of(path)


def _images_of(path: Path) -> list[Path]:
    from ..codecs.sog import MAX_META, companion_names

    if not path.is_file() or path.stat().st_size > MAX_META:
        return []
    return _beside(path, companion_names(path.read_bytes()))


def _beside(path: Path, names: Iterable[str], *, folders: bool = False) -> list[Path]:
    """Return the paths of the files that a file names, without names that lead away."""
    unique = dict.fromkeys(names)  # an untrusted manifest may name one file half a million times
    return [path.parent / name for name in unique if not leads_away(name, folders=folders)]


def in_folder(folder: Place) -> Place:
    """Return the splat file in a folder: a manifest of Streamed SOG or 3D Tiles, or a SOG's meta.json.

    Raises `UnreadableError` if the folder has none or several.
    """
    found = [name for name in FIRST_FILES if (folder / name).is_file()]
    if len(found) > 1:
        raise UnreadableError(f"cannot be read: is a directory with {' and '.join(found)}; give one of them")
    if not found:
        scans = _scans_in(folder) if isinstance(folder, Path) else ""
        raise UnreadableError(
            f"cannot be read: is a directory, without the {META} of an unpacked SOG, a {MANIFEST} or a {TILESET}{scans}"
        )
    return folder / found[0]


def _scans_in(folder: Path) -> str:
    known = {suffix for form in FORMATS for suffix in form.suffixes} - {PurePath(META).suffix}
    with os.scandir(folder) as entries:
        files = [entry.name for entry in itertools.islice(entries, MOST_NAMES) if entry.is_file()]
    suffixes = Counter(suffix for name in files if (suffix := PurePath(name).suffix).lower() in known)
    if not suffixes:
        return ""
    suffix, count = suffixes.most_common(1)[0]
    only = next(name for name in files if name.endswith(suffix))
    return f"; give {shlex.quote(str(folder))}/{f'*{suffix}' if count > 1 else shlex.quote(only)}"


def check_companion(name: str, *, folders: bool = False) -> None:
    """Raise `FormatError` if a name in an untrusted file leads away from it, see `leads_away`."""
    if leads_away(name, folders=folders):
        raise FormatError(f"it names {quoted_value(name)}, which is not a file beside it")


def open_named(first: Place, name: str, *, folders: bool = False) -> BinaryIO:
    """Open a file that an untrusted file names: beside it or, if `folders`, below its folder."""
    if first == DASH:
        raise FormatError(f"it names {quoted_value(name)}, but standard input has no folder; give the path instead")
    check_companion(name, folders=folders)
    path = first.parent / name
    try:
        if path.exists() and not path.is_file():
            raise FormatError(f"{quoted_value(name)}, which it names, is not a file")
        file = path.open("rb")
    except OSError as error:
        raise FormatError(f"{quoted_value(name)}, which it names, cannot be read: {reason_of(error)}") from None
    if is_pointer(file.read(SHORT)):
        file.close()
        raise FormatError(f"{quoted_value(name)}, which it names, is {POINTER}")
    file.seek(0)
    return file


def size_of_input(path: Place) -> int | None:
    """Return the size of a file or of standard input, bytes; None if unknown."""
    try:
        if path == DASH:
            return spooled().seek(0, os.SEEK_END)
        return size_of(path) if path.is_file() else None
    except (UnreadableError, OSError):
        return None


#: Largest text that is read, bytes: instances, expectations, matrices. Parsed, it may take thirty times as much.
MAX_TEXT = 1 << 24


def read_text(path: Path) -> str:
    """Read a text file of at most `MAX_TEXT` bytes; an `UnreadableError` names it."""
    try:
        return decoded_text(_read_up_to(path, MAX_TEXT))
    except (OSError, ValueError) as error:
        reason = reason_unreadable(error) if isinstance(error, OSError) else "it is not text"
        raise UnreadableError(f"{path} cannot be read: {reason}") from None


def read_together(path: Path, sets: Collection[Collection[str]], limit: int) -> dict[str, bytes]:
    """Read files that belong together, and return their bytes by name; the file of `path` is the first.

    Args:
        path: of a file, or of a folder that holds one of the sets.
        sets: names of files that belong together; if `path` is in a set, the other files of the set are read, too.
        limit: largest file, bytes.

    Raises:
        UnreadableError: a file is missing or too large; the error names it.
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
            rest = next((names for names in sets if path.name in names), ())
            names = [path.name, *(name for name in rest if name != path.name and (folder / name).is_file())]
        return {name: _read_up_to(folder / name, limit) for name in names}
    except OSError as error:
        raise UnreadableError(f"{path} cannot be read: {reason_unreadable(error)}") from None


def read_rgba(path: Path, count: int, rows: slice | None = None) -> FloatArray:
    """Read an array file of colours and opacities for the splats of a scene; a `FormatError` names it.

    Args:
        count: number of splats of the scene.
        rows: the splats whose values are read; None for all.

    Returns:
        (N, 4) float32, see `layouts.decode_rgba`.
    """
    from ..codecs import layouts

    try:
        if path.exists() and not path.is_file():
            raise FormatError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            if is_pointer(file.read(SHORT)):
                raise FormatError(f"cannot be read: it is {POINTER}")
            file.seek(0)
            return layouts.decode_rgba(file, count, rows)
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
