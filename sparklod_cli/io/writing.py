"""Outputs, written whole or not at all: a file, a header with the files that it names, or objects at addresses."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..codecs.encoder import Get
from ..codecs.formats import Format
from ..codecs.options import WriteOptions
from ..model.scene import Scene
from ..system import atomic, atomic_set
from ..system.addresses import Address, Place
from ..system.errors import OutputError, StdoutError
from ..system.progress import Progress, silent
from ..system.stdio import DASH, ReaderGoneError, guarded
from ..system.units import format_size
from .local_files import number_of, reason_of

if TYPE_CHECKING:
    from ..codecs.rad.rad_reader import RadReader


#: Writes the pieces of an output and returns how many bytes it wrote.
Sink = Callable[[Iterable[bytes]], int]

#: Names and contents of files, one after the other.
Files = Iterable[tuple[str, Iterable[bytes]]]

#: Writes such files and returns how many bytes it wrote.
SinkTogether = Callable[[Files], int]


def check_writable(path: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` where an output cannot be written, before work goes into it.

    At an address, its service has to answer; whether it lets files be written is not tried, as others would see them.
    """
    check_free(path, overwrite=overwrite)
    if isinstance(path, Path) and not _is_no_file(path):
        try_place(path)
    elif isinstance(path, Path) and not os.access(path, os.W_OK):
        raise OutputError(f"cannot write {path}: {os.strerror(errno.EACCES).lower()}")


def check_free(path: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` where an output is a folder or exists, or where nothing can be written by its name."""
    try:
        if isinstance(path, Address):
            if path.is_read_only:
                raise OutputError(f"cannot write {path}: {path.scheme}:// is for reading; write a file and upload that")
        elif path.is_dir():
            raise OutputError(f"{path} is a directory")
        if path.is_file() and not overwrite:
            raise _taken(path)
        if isinstance(path, Path) and not _is_no_file(path):
            _nearest_folder(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def try_place(path: Path, *, least: int = 0) -> None:
    """Raise `OutputError` where a file, or a folder, cannot be written or replaced; leave nothing there.

    Permission and room are tried by a temporary file in its folder, or in the nearest one on the way to it that
    exists: `write_whole` makes the others.

    Args:
        least: bytes that it will take at least.
    """
    try:
        target, nearest = Path(os.path.realpath(path)), _nearest_folder(path)
        for name in target.relative_to(nearest).parts:
            with contextlib.suppress(FileNotFoundError):
                (nearest / name).lstat()  # raises where the file system takes no such name
        atomic.attempt(nearest)
        if os.path.lexists(target):
            atomic.check_replaceable(target)
        free = shutil.disk_usage(nearest).free if least else 0
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None
    if least > free:
        raise OutputError(
            f"cannot write {path}: it takes {format_size(least)} or more, and {format_size(free)} are free there"
        )


def _nearest_folder(path: Path) -> Path:
    """Return the nearest folder on the way to a file; raise `OutputError` where something else is in its place."""
    nearest = next(folder for folder in Path(os.path.realpath(path)).parents if os.path.lexists(folder))
    if not nearest.is_dir():
        raise OutputError(f"cannot write {path}: {nearest} is a file, not a folder")
    return nearest


def write_whole(path: Place, pieces: Iterable[bytes], *, overwrite: bool) -> int:
    """Write a file so that it appears complete or not at all, and return its size; make its folder if need be.

    It gets its name when it is filled and synced, see `atomic`; an interruption leaves nothing behind.

    Raises:
        OutputError: it exists and `overwrite` is not set, or the file system, or the service, refused something.
    """
    check_free(path, overwrite=overwrite)
    try:
        if isinstance(path, Address):
            return path.write(pieces)
        if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
            with path.open("wb") as file:
                return sum(map(file.write, pieces))
        target = Path(os.path.realpath(path))
        with atomic.created(target.parent):
            return atomic.write(target, pieces, overwrite=overwrite)
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def sink(path: Place, *, overwrite: bool) -> Sink:
    """Return the function that writes an output; - is standard output. Fail now if it cannot be written later.

    Raises:
        OutputError: see `check_writable`.
    """
    if path == DASH:
        return write_stdout
    check_writable(path, overwrite=overwrite)
    return functools.partial(write_whole, path, overwrite=overwrite)


def write_stdout(pieces: Iterable[bytes], *, may_end: bool = False) -> int:
    """Write to standard output and return the number of bytes; raise `StdoutError` if they cannot be written.

    Args:
        may_end: a reader may close after the first lines, as head does, which raises `ReaderGoneError`; otherwise that
            is a `StdoutError`, too.
    """
    size = 0
    with guarded():
        try:
            for piece in pieces:
                size += sys.stdout.buffer.write(piece)
            sys.stdout.buffer.flush()
        except ReaderGoneError as error:
            if may_end:
                raise
            raise StdoutError(str(error)) from None
    return size


def chunk_files(path: Place) -> list[Place]:
    """Return the existing files beside a header whose names match its pattern, in the order of their numbers.

    Raises:
        OutputError: the service does not list those at an address.
    """
    target = real_target(path)
    try:
        if isinstance(target, Address):
            names = [name for name in target.parent.files() if "/" not in name]
        else:
            names = [each.name for each in target.parent.iterdir()]
    except OSError as error:
        if isinstance(target, Path):
            return []
        raise OutputError(f"cannot list {target.parent}: {reason_of(error)}") from None
    numbers = {number_of(name, target.name): target.parent / name for name in names}
    return [numbers[number] for number in sorted(number for number in numbers if number is not None)]


def real_target(path: Place) -> Place:
    """Return where the files of an output go: where a symbolic link leads."""
    return path if isinstance(path, Address) else Path(os.path.realpath(path))


def write_together(path: Place, files: Files, *, overwrite: bool) -> int:
    """Write a header and the files that it names, all or none of them, and return their size; make their folder.

    With `overwrite`, files of a larger output that was there before are removed. See `atomic_set.write` and
    `send_together` for what an interruption leaves.

    Args:
        path: of the header; where it is a symbolic link, all files go to where that leads.
        files: names in the folder of the header, and their content; the last is the header, whose name is that of
            `path`.

    Raises:
        OutputError: a file exists and `overwrite` is not set, or the file system, or the service, refused something.
    """
    check_together(path, overwrite=overwrite)
    target = real_target(path)
    placed = ((target.name if number_of(name, target.name) is None else name, pieces) for name, pieces in files)
    return write_set(path, placed, former=[each.name for each in chunk_files(target)], overwrite=overwrite)


def write_set(path: Place, files: Files, *, former: Sequence[str], overwrite: bool) -> int:
    """Write a file and those that it names, all or none of them, and return their size; make their folder.

    Args:
        path: of the last file; where it is a symbolic link, all files go to where that leads.
        files: names, with the folders that they are in there, and contents; the last one is the name of the target.
        former: names of files of a former output, which are removed where no new one has their name.

    Raises:
        OutputError: see `write_together`.
    """
    target = real_target(path)
    if isinstance(target, Address):
        return send_together(target, files, former=[target.parent / name for name in former], overwrite=overwrite)
    try:
        with atomic.created(target.parent):
            return atomic_set.write(
                target.parent,
                files,
                overwrite=overwrite,
                outdated=lambda names: [name for name in former if name not in names],
            )
    except FileExistsError as error:
        raise _taken(Path(error.filename or target)) from None
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from None


def sink_together(path: Place, *, overwrite: bool) -> SinkTogether:
    """Return the function that writes a header and the files that it names. Fail now if that will not be possible.

    Raises:
        OutputError: it is no place for several files, or see `check_writable`.
    """
    check_together(path, overwrite=overwrite)
    return functools.partial(write_together, path, overwrite=overwrite)


def check_header(path: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` where a file that names others cannot be written, before work goes into it."""
    if path == DASH:
        raise OutputError("standard output cannot take several files; name a file")
    check_writable(path, overwrite=overwrite)
    if isinstance(path, Path) and _is_no_file(path):
        raise OutputError(f"{path} is a pipe or a device, which cannot take several files; name a file")


def check_together(path: Place, *, overwrite: bool) -> None:
    """Raise `OutputError` where a header, or a file that it names, cannot be written."""
    check_header(path, overwrite=overwrite)
    for each in [] if overwrite and isinstance(path, Address) else chunk_files(path):
        if not overwrite or (isinstance(each, Path) and _is_no_file(each)):
            raise _taken(each)


def _taken(path: Place) -> OutputError:
    if isinstance(path, Path) and _is_no_file(path):
        return OutputError(f"{path} is not a file; move it away, or name another output")
    return OutputError(f"{path} exists, add --overwrite to replace it")


def _is_no_file(path: Path) -> bool:
    return path.exists() and not path.is_file()


def send_together(address: Address, files: Files, *, former: Sequence[Address], overwrite: bool) -> int:
    """Write files at addresses, and then the one that names them; return their size.

    If something fails, what was sent is removed, so that no header names files that are not there. Where files are
    replaced, the old header is removed first for the same reason: services replace one object at a time.

    Args:
        files: names, with the folders that they are in there, and contents; the last is that of `address`.
        former: files of a former output, which are removed where no new one has their name.

    Raises:
        OutputError: the header exists and `overwrite` is not set, or a file cannot be sent.
    """
    check_free(address, overwrite=overwrite)
    sent, size = list[Address](), 0
    try:
        address.unlink(missing_ok=True)
        for name, pieces in files:
            place = address if name == address.name else address.parent / name
            sent.append(place)
            size += place.write(pieces)
        for outdated in former:
            if outdated not in sent:
                outdated.unlink(missing_ok=True)
    except BaseException as error:
        for place in reversed(sent):
            with contextlib.suppress(OSError):
                place.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {address}: {reason_of(error)}") from None
        raise
    return size


@dataclass(frozen=True)
class SceneSink:
    """Writes a scene.

    Attributes:
        form: that is written.
        whole: writes one file; None for several.
        together: writes a header and the files that it names; None for one file.
        stem: of the names of chunks.
    """

    form: Format
    whole: Sink | None
    together: SinkTogether | None
    stem: str

    def __call__(self, scene: Scene, options: WriteOptions, *, threads: int = 1, progress: Progress = silent) -> int:
        """Write a scene and return how many bytes it wrote.

        Raises:
            OutputError: see `scene_sink`; and what the codec raises.
        """
        codec = self.form.codec()
        if self.whole is not None:
            return self.whole(codec.encode(scene, options, threads=threads, progress=progress))
        assert self.together is not None
        if self.form.unbundled is not None:
            files = codec.encode_files(scene, options, threads=threads, progress=progress)
            return self.together((name, (content,)) for name, content in files)
        return self.together(codec.encode_chunked(scene, options, self.stem, threads=threads, progress=progress))

    def repack(self, chunks: RadReader) -> int:
        """Write the chunks of a RAD file as they stand, and return how many bytes were written.

        Raises:
            OutputError: see `scene_sink`.
        """
        if self.whole is not None:
            return self.whole(chunks.in_one_file())
        assert self.together is not None
        return self.together(chunks.in_files(self.stem))

    def assemble(self, encoder: Any, get: Get, *, threads: int = 1, progress: Progress = silent) -> int:
        """Write a tree whose windows are encoded, and return how many bytes it wrote.

        Raises:
            OutputError: see `scene_sink`.
        """
        if self.whole is not None:
            return self.whole(encoder.pieces(get, threads=threads, progress=progress))
        assert self.together is not None
        return self.together(encoder.files(get, self.stem, progress=progress))


def scene_sink(path: Place, form: Format, *, chunked: bool = False, overwrite: bool) -> SceneSink:
    """Return what writes a scene in a format. Fails now if the output cannot be written later.

    Args:
        path: of the file, or of the header where `chunked`; - is standard output, for one file. One that is called as
            the `unbundled` of the format has the other files beside it.
        chunked: with each chunk in a file of its own, beside the header; of RAD.

    Raises:
        OutputError: see `sink` and `sink_together`. Writing raises that, too, and what the codec raises.
    """
    stem = real_target(path).stem
    if chunked or path.name.lower() == form.unbundled:
        return SceneSink(form, None, sink_together(path, overwrite=overwrite), stem)
    return SceneSink(form, sink(path, overwrite=overwrite), None, stem)
