"""Readers of splat files of any format, alone or several as one scene, which need not fit into memory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import tempfile
import threading
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ..codecs.reader import Reader, Source, Target
from ..model.scene import Scene
from ..model.splats import COLUMNS
from ..model.transforms import Transform
from ..system import atomic
from ..system.addresses import Address, Place
from ..system.errors import FormatError, OutputError, reason_of
from ..system.progress import Progress, silent
from ..system.stdio import DASH, name_of
from .reading import open_splats, readable

#: Files that stay open together, of one scene, and of those that were closed or that another process opened: each has
#: a palette of up to 12 MB. Chosen.
MOST = 4

_LOCK = threading.Lock()


def read_scene(
    path: Place,
    *,
    columns: Collection[str] = COLUMNS,
    threads: int = 1,
    progress: Progress = silent,
    validate: bool = True,
) -> Scene:
    """Read a splat file of any known format, told by its content, or else by its suffix.

    Args:
        path: of a file, or of a folder that holds an unpacked SOG or a Streamed SOG; - is standard input.
        columns: of the splats that are needed; the others may be 0.
        validate: refuse a broken tree.

    Raises:
        FormatError: it is not a file, empty, of no known format, or broken.
    """
    with open_reader(path, threads=threads) as reader:
        return reader.scene(columns=columns, progress=progress, validate=validate)


@contextlib.contextmanager
def open_reader(path: Place, *, scratch: Path | None = None, threads: int = 1) -> Iterator[Reader]:
    """Open a file of any known format.

    Only its header is read now. Any range of splats can be read until the end, on several threads. Columns that lie one
    after the other (SPZ, SOG), and text, are unpacked once, when a block is first read; see docs/formats.md for the
    room that takes.

    Args:
        scratch: folder for what is unpacked, which stays there, so that other processes find it; whoever owns the
            folder removes it. The reader can be pickled then. None for one of the system's temporary files.

    Raises:
        FormatError: as `io.read_scene`. What is wrong behind the header is raised by reading; so is `OutputError`,
            where there is no room for what is unpacked.
    """
    with contextlib.ExitStack() as closing:
        with readable():
            version = _version(path, scratch)
            reader = _opened(path, version, scratch, threads, closing)
        fill = _FillFromFile(path, version, scratch, threads, reader.count, reader.sh_degree, reader)
        yield dataclasses.replace(reader, fill=fill)


def _version(path: Place, scratch: Path | None) -> tuple[Any, ...]:
    """Return what changes with a file; nothing where finding out takes a request that only large scenes are worth."""
    if path == DASH or (isinstance(path, Address) and scratch is None):
        return ()
    if isinstance(path, Address):
        return (path.version(),)
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _opened(
    path: Place, version: tuple[Any, ...], folder: Path | None, threads: int, closing: contextlib.ExitStack
) -> Reader:
    """Open a file until `closing` closes it, and what is unpacked of it."""
    lock, unpacked = threading.Lock(), list[BinaryIO]()

    def scratch(pieces: Callable[[], Iterable[bytes]]) -> BinaryIO:
        with lock, _room(folder):
            if not unpacked:
                place = folder and folder / f"{_digest(path, version)}.unpacked"
                file = _temporary(pieces) if place is None else _kept(place, pieces)
                unpacked.append(closing.enter_context(file))
        return unpacked[0]

    file, form, more = open_splats(path, closing)
    reader: Reader = form.codec().open_content(Source(file, scratch=scratch, threads=threads, **more))
    return dataclasses.replace(reader, threads=threads)


def _temporary(pieces: Callable[[], Iterable[bytes]]) -> BinaryIO:
    """Write a file without a name, which is gone with this process at the latest."""
    file: BinaryIO = tempfile.TemporaryFile(prefix="sparklod-")  # noqa: SIM115
    try:
        for piece in _readable(pieces):
            file.write(piece)
        file.flush()
    except BaseException:
        file.close()
        raise
    return file


def _kept(target: Path, pieces: Callable[[], Iterable[bytes]]) -> BinaryIO:
    """Write a file unless it is there; it appears whole or not at all."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        atomic.write(target, _readable(pieces), overwrite=True)
    return target.open("rb")


def _readable(pieces: Callable[[], Iterable[bytes]]) -> Iterator[bytes]:
    with readable():
        yield from pieces()


def _digest(path: Place, version: tuple[Any, ...]) -> str:
    """Return a name for this version of a file."""
    parts = (path.url if isinstance(path, Address) else path.absolute(), *version)
    return hashlib.sha256("\n".join(map(str, parts)).encode("utf-8", "surrogateescape")).hexdigest()[:32]


@contextlib.contextmanager
def _room(folder: Path | None) -> Iterator[None]:
    """Turn an `OSError` of the body into an `OutputError`."""
    try:
        yield
    except OSError as error:
        where = folder or tempfile.gettempdir()
        raise OutputError(f"cannot write to the scratch folder {where}: {reason_of(error)}") from None


@dataclass(frozen=True, eq=False)
class _FillFromFile:
    """`Reader.fill` of a file, which is opened again in another process, where it was closed, and where it changed."""

    path: Place
    version: tuple[Any, ...]
    scratch: Path | None
    threads: int
    count: int
    sh_degree: int
    reader: Reader | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, target: Target, threads: int, progress: Progress) -> None:
        with readable():
            reader, version = self.reader, _version(self.path, self.scratch)
            if reader is None or version != self.version:
                with _LOCK:
                    reader = _opened_again(self.path, version, self.scratch, self.threads)
            if (reader.count, reader.sh_degree) != (self.count, self.sh_degree):
                raise FormatError("it was changed while it was read; start again")
            with contextlib.nullcontext() if reader.concurrent else self.lock:
                reader.fill(target, threads, progress)

    def __reduce__(self) -> tuple[Any, ...]:
        return _FillFromFile, (self.path, self.version, self.scratch, self.threads, self.count, self.sh_degree)


@functools.lru_cache(MOST)
def _opened_again(path: Place, version: tuple[Any, ...], scratch: Path | None, threads: int) -> Reader:
    """Open a file, which is closed when many others have been opened since and nobody reads it."""
    closing = contextlib.ExitStack()
    with contextlib.ExitStack() as after_an_error:
        after_an_error.enter_context(closing)
        reader = _opened(path, version, scratch, threads, closing)
        after_an_error.pop_all()
    weakref.finalize(reader, closing.close)
    return reader


@dataclass(frozen=True, eq=False)
class PlacedFile:
    """A file and where its splats stand.

    Attributes:
        file: of any format that is read, without a tree.
        transform: turns, scales and moves them.
    """

    file: Place
    transform: Transform = field(default_factory=Transform)


@contextlib.contextmanager
def open_readers(files: Sequence[PlacedFile], *, scratch: Path | None = None, threads: int = 1) -> Iterator[Reader]:
    """Open several files as one scene; see `merged`. The header of a file that is named twice is read once.

    Raises:
        HasTreeError, FormatError: as `open_reader`; names the file.
    """
    from ..codecs.merging import Placed, merged, naming  # what a single file does without

    readers = dict[Place, Reader]()
    with contextlib.ExitStack() as closing:
        for file in dict.fromkeys(each.file for each in files):
            with naming(name_of(file)), contextlib.ExitStack() as own:
                reader = own.enter_context(open_reader(file, scratch=scratch, threads=threads))
                reader.check_plain()
                if len(readers) < MOST:
                    closing.push(own.pop_all())
                else:  # it is opened again when it is read
                    assert isinstance(reader.fill, _FillFromFile)
                    reader = dataclasses.replace(reader, fill=dataclasses.replace(reader.fill, reader=None))
                readers[file] = reader
        closing.callback(_opened_again.cache_clear)
        yield merged([Placed(readers[each.file], name_of(each.file), each.transform) for each in files])
