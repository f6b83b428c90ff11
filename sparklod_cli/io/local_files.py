"""Plain files: names, companions of a splat file, texts, and reasons why a file cannot be opened."""

from __future__ import annotations

import functools
import itertools
import os
import shlex
import stat
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path, PurePath
from typing import BinaryIO

from ..codecs.formats import FIRST_FILES, FORMATS, MANIFEST, META, POINTER, SHORT, TILESET, head_of, is_pointer, sniff
from ..model.splats import FloatArray
from ..system.addresses import Place, size_of
from ..system.errors import FormatError, UnreadableError, reason_of
from ..system.stdio import DASH, spooled
from ..system.untrusted import decoded_text, near, quoted_value

#: Names in a folder that are compared with a missing one: more take longer than a person waits for an error.
MOST_NAMES = 10_000

#: Least similarity, as `difflib` measures it, of a missing name and a suggested one: a letter or two differ, or the
#: suffix.
SIMILAR = 0.75


def is_file_name(text: str) -> bool:
    """Return whether a text can be a file name, without the byte 0 or half of a surrogate pair."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def leads_away(name: str, *, folders: bool = False) -> bool:
    """Return whether a name may lead out of the folder of its file, or below it unless `folders`."""
    if folders and "/" in name:
        return any(leads_away(part) for part in name.split("/"))
    return name in ("", ".", "..") or any(mark in name for mark in "/\\:") or not is_file_name(name)


def reason_unreadable(error: OSError) -> str:
    """Return the system's reason why an input cannot be read, and a file of a similar name if it is missing."""
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
    """Open a plain file for reading, by an absolute path without links, from `Path.resolve`.

    Raises `OSError` if it is missing, or a folder, a pipe or a device, or if it or a folder above has become a link.
    """
    file = os.fdopen(os.open(path, _FLAGS), "rb")
    try:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise OSError(f"{path} is not a plain file")
        # Only the last part of a path is not followed by opening it. The file is compared, as a link may come and go.
        if path.resolve() != path or not os.path.samestat(found, path.lstat()):
            raise OSError(f"{path} has become a link")
    except OSError:
        file.close()
        raise
    return file


#: Formats whose buffers may be files.
GLTF = ("GLB", "glTF")


def companions(path: Path, sets: Collection[Collection[str]]) -> list[Path]:
    """Return the files that are read together with one; none if they cannot be found. Raises nothing."""
    try:
        folder = path if path.is_dir() else path.parent
        first: Path | None = path
        if path.is_dir():
            first = next((folder / name for name in FIRST_FILES if (folder / name).is_file()), None)
            names = [*([] if first is None else [first.name]), *itertools.chain(*sets)]
        else:
            names = list(itertools.chain(*(names for names in sets if path.name in names)))
        files = _companion_paths(folder / MANIFEST, names)
        if first is not None and first.is_file():
            files += _named_in(first)
        return [file for file in files if file.is_file()]
    except (OSError, ValueError, FormatError):
        return []


def _named_in(path: Path) -> list[Path]:
    """Return the files that a splat file names: images of a SOG, chunks of a RAD, all of the other formats."""
    with path.open("rb") as file:
        head = head_of(file)
        form = sniff(head, path.suffix)
        if form is not None and not form.companions:
            return []
        from ..codecs.gltf_container import GltfFile
        from ..codecs.rad import rad_header
        from ..codecs.reader import OpenFile  # what most jobs do without, as what follows
        from ..codecs.streamed_manifest import MAX_MANIFEST, parse
        from ..codecs.tiles_3d import names_of
        from ..codecs.tileset import MAX_TILESET

        if head.startswith(rad_header.MAGIC):
            return _companion_paths(path, rad_header.read_header(file).filenames)
        if form is not None and form.parts == "tiles":
            names = names_of(file.read(MAX_TILESET + 1), functools.partial(open_named, path, folders=True))
            return _companion_paths(path, names, folders=True)
        if form is not None and form.name in GLTF:
            return _companion_paths(path, GltfFile(OpenFile(file)).names(), folders=True)
        if form is not None and form.folders:
            metas = _companion_paths(path, parse(file.read(MAX_MANIFEST + 1)).names(), folders=True)
            return [*metas, *itertools.chain(*map(_images_of, metas))]
    return _images_of(path)


def _images_of(path: Path) -> list[Path]:
    from ..codecs.sog import MAX_META, companion_names

    if not path.is_file() or path.stat().st_size > MAX_META:
        return []
    return _companion_paths(path, companion_names(path.read_bytes()))


def _companion_paths(path: Path, names: Iterable[str], *, folders: bool = False) -> list[Path]:
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
    """Raise `FormatError` if a name in a file may lead out of its folder, see `leads_away`."""
    if leads_away(name, folders=folders):
        raise FormatError(f"it names {quoted_value(name)}, which is not a file beside it")


def open_named(first: Place, name: str, *, folders: bool = False) -> BinaryIO:
    """Open a file that another one names, which may be in a folder there if `folders`; raises `FormatError`."""
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
    """Return bytes of a file, or of standard input; None if unknown."""
    try:
        if path == DASH:
            return spooled().seek(0, os.SEEK_END)
        return size_of(path) if path.is_file() else None
    except (UnreadableError, OSError):
        return None


#: Most bytes of a text that is read whole: instances, expectations, matrices. Parsed, it may take thirty times as much.
MAX_TEXT = 1 << 24


def read_text(path: Path) -> str:
    """Read a text file of at most `MAX_TEXT` bytes; raises `UnreadableError`, which names it."""
    try:
        return decoded_text(_read_up_to(path, MAX_TEXT))
    except (OSError, ValueError) as error:
        reason = reason_unreadable(error) if isinstance(error, OSError) else "it is not text"
        raise UnreadableError(f"{path} cannot be read: {reason}") from None


def read_together(path: Path, sets: Collection[Collection[str]], limit: int) -> dict[str, bytes]:
    """Read files that belong together, and return them by name; the file of `path` is the first.

    Args:
        path: of a file, or of a folder that holds one of the sets.
        sets: names of files that belong together; if `path` is in a set, the other files of it are read, too.
        limit: most bytes of a file; a larger or missing file raises `UnreadableError`, which names it.
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
    """Read colours and opacities for the `count` splats of a scene or a range; raises `FormatError`, which names it."""
    from ..codecs import array_files

    try:
        if path.exists() and not path.is_file():
            raise FormatError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            if is_pointer(file.read(SHORT)):
                raise FormatError(f"cannot be read: it is {POINTER}")
            file.seek(0)
            return array_files.decode_rgba(file, count, rows)
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
