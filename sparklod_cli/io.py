"""The only module that opens paths: tells formats, reads scenes, and writes files whole or not at all."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .codecs import rgba
from .codecs.formats import FORMATS, HEAD, Format, sniff
from .codecs.gpu import dump
from .codecs.gpu.table import NPZ, RAW_SUFFIXES
from .codecs.sog_files import MAX_META, META, names_beside
from .model.scene import Scene
from .model.splats import COLUMNS, FloatArray
from .support import atomic
from .support.errors import FormatError, OutputError, StdoutError, UnknownFormatError, UnreadableError
from .support.progress import Progress, silent
from .support.stdin import DASH, spooled
from .support.stdout import ReaderGoneError, guarded
from .support.untrusted import quoted_value

#: How a .npz begins, which is a zip.
ZIP = b"PK\x03\x04"

#: Bytes of a text that is read whole: instances, expectations, matrices. Parsed it may take thirty times as much.
MAX_TEXT = 1 << 24

#: Writes the pieces of an output and returns how many bytes it wrote.
Sink = Callable[[Iterable[bytes]], int]


def read_scene(path: Path, *, threads: int = 1, progress: Progress = silent) -> Scene:
    """Reads a splat file of any known format, told by its content, or else by its suffix.

    Args:
        path: of a file, or of a folder that holds an unpacked SOG; - is standard input.
        threads: to decode with.
        progress: is told how much is done.

    Raises:
        FormatError: it is not a file, empty, of no known format, or broken.
    """
    with _opened(path) as (file, form, more):
        scene: Scene = form.codec().decode(file, threads=threads, progress=progress, **more)
    return scene


def examine_scene(
    path: Path, *, columns: Collection[str] = COLUMNS, threads: int = 1, progress: Progress = silent
) -> Scene:
    """Reads a splat file for a report on it: its tree may be broken, and columns that are not asked for may be 0.

    Args:
        path: as for `read_scene`.
        columns: of `Splats`.
        threads: to decode with.
        progress: is told how much is done.

    Raises:
        FormatError: as `read_scene`, but for the tree.
    """
    with _opened(path) as (file, form, more):
        codec = form.codec()
        if form.selective:
            scene: Scene = codec.examine(file, columns=columns, threads=threads, progress=progress, **more)
        else:
            scene = codec.decode(file, threads=threads, progress=progress, **more)
    return scene


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, Format, dict[str, Any]]]:
    """A splat file, its format, and what else its codec takes."""
    try:
        if path.is_dir():
            path = _in_folder(path)
        if path != DASH and path.exists() and not path.is_file():
            raise UnreadableError("it is a pipe or a device; save it to a file first")
        with _file_of(path) as file:
            head = file.read(HEAD)
            file.seek(0)
            if not head:
                raise UnreadableError("the file is empty")
            form = sniff(head, path.suffix)
            if form is None:
                names = ", ".join(form.name for form in FORMATS)
                hint = "; a .splat file is not recognised by its content: pass it as a file" if path == DASH else ""
                if path.suffix.lower() in RAW_SUFFIXES:
                    hint = "; words alone, as --encoding writes them by this suffix, do not tell what they are"
                raise UnknownFormatError(f"not a splat file that sparklod reads ({names}){hint}")
            if head.startswith(ZIP) and path.suffix.lower() == NPZ:
                raise UnknownFormatError(
                    "it holds arrays for a viewer and no scene; use the file that they were made of, or unpack them in"
                    " Python"
                )
            yield file, form, {"beside": functools.partial(_open_beside, path)} if form.companions else {}
    except OSError as error:
        raise UnreadableError(f"cannot be read: {_reason(error)}") from None


def read_arrays(path: Path) -> dump.Arrays | None:
    """The arrays of a .npz file; None where a file is something else, or cannot be opened.

    Raises:
        FormatError: an array is damaged, or of no plain numbers.
    """
    try:
        if path != DASH and not path.is_file():
            return None
        with _file_of(path) as file:
            if file.read(len(ZIP)) != ZIP:
                return None
            return dump.decode_npz(file)
    except (OSError, UnreadableError):
        return None


def _file_of(path: Path) -> contextlib.AbstractContextManager[BinaryIO]:
    """A file that is closed at the end, or standard input, which is not."""
    return contextlib.nullcontext(spooled()) if path == DASH else path.open("rb")


def size_of_input(path: Path) -> int | None:
    """Bytes of a file, or of standard input; None where that cannot be told."""
    try:
        if path == DASH:
            return spooled().seek(0, os.SEEK_END)
        return path.stat().st_size if path.is_file() else None
    except UnreadableError:
        return None
    except OSError:
        return None


def read_text(path: Path) -> str:
    """A text file of at most `MAX_TEXT` bytes; `UnreadableError`, naming it, where that cannot be."""
    try:
        return str(_read_up_to(path, MAX_TEXT), "utf-8-sig")
    except (OSError, ValueError) as error:
        reason = _reason(error) if isinstance(error, OSError) else "it is not text"
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
        raise UnreadableError(f"{path} cannot be read: {_reason(error)}") from None


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
        if meta.is_file() and meta.stat().st_size <= MAX_META:
            with meta.open("rb") as file:
                if file.read(HEAD).lstrip().startswith(b"{"):
                    file.seek(0)
                    names += names_beside(file.read())
        beside = [folder / name for name in names if not _leads_away(name)]
        return [file for file in beside if file.is_file()]
    except (OSError, ValueError):
        return []


def _read_up_to(path: Path, limit: int) -> bytes:
    if path.is_dir():
        raise UnreadableError(f"{path} cannot be read: is a directory")
    if path.exists() and not path.is_file():
        raise UnreadableError(f"{path} cannot be read: it is a pipe or a device; save it to a file first")
    if path.stat().st_size > limit:
        raise UnreadableError(f"{path} is larger than {limit >> 20:,} MiB, which nothing of its kind is")
    return path.read_bytes()


def _in_folder(folder: Path) -> Path:
    path = folder / META
    if not path.is_file():
        raise UnreadableError("cannot be read: is a directory, without the meta.json of an unpacked SOG")
    return path


def _leads_away(name: str) -> bool:
    """Whether a name could mean something else than a file in the same folder."""
    return name in ("", ".", "..") or any(mark in name for mark in "/\\:") or not is_file_name(name)


def _open_beside(first: Path, name: str) -> BinaryIO:
    """Opens a file that another one names; `FormatError` where the name could lead out of their folder."""
    if first == DASH:
        raise FormatError(f"it names {quoted_value(name)}, but standard input has no folder; give the path instead")
    if _leads_away(name):
        raise FormatError(f"it names {quoted_value(name)}, which is not a file beside it")
    path = first.parent / name
    try:
        if path.exists() and not path.is_file():
            raise FormatError(f"{quoted_value(name)}, which it names, is not a file")
        return path.open("rb")
    except OSError as error:
        raise FormatError(f"{quoted_value(name)}, which it names, cannot be read: {_reason(error)}") from None


def is_file_name(text: str) -> bool:
    """Whether a text can be a file name: no system takes the byte 0 or half of a surrogate pair."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def read_rgba(path: Path, count: int) -> FloatArray:
    """Colours and opacities for the `count` splats of a scene, see `rgba.decode`: (count, 4) float32, 0..1.

    Raises:
        FormatError: it cannot be read or is not such a file; names it.
    """
    try:
        if path.exists() and not path.is_file():
            raise FormatError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            return rgba.decode(file, count)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {_reason(error)}") from None
    except FormatError as error:
        raise type(error)(f"{path} {error}") from None


def check_writable(path: Path, *, overwrite: bool) -> None:
    """Raises `OutputError` where an output cannot be written, before work goes into it.

    Folders on the way to it that do not exist are no error: `write_whole` makes them.

    Args:
        path: of the output.
        overwrite: an existing file may be replaced.
    """
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
        raise OutputError(f"cannot write {path}: {_reason(error)}") from None


def write_whole(path: Path, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Writes a file so that it appears complete or not at all, and returns its size; makes its folder if need be.

    It gets its name when it is filled and synced, see `whole`; an interruption leaves nothing behind.

    Raises:
        OutputError: it exists and `overwrite` is not set, or the file system refused something.
    """
    check_writable(path, overwrite=overwrite)
    try:
        if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
            with path.open("wb") as file:
                return sum(map(file.write, pieces))
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        return atomic.write(target, pieces, overwrite=overwrite)
    except FileExistsError:
        raise OutputError(f"{path} exists, add --overwrite to replace it") from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {_reason(error)}") from None


def sink(path: Path, *, overwrite: bool) -> Sink:
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


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
