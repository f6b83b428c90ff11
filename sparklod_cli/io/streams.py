"""Splat files of any format as streams of blocks, so that they need not fit into memory."""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import functools
import hashlib
import os
import tempfile
import threading
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

from ..codecs.content import Content, Source
from ..model.splats import Splats
from ..model.streams import Placed, SceneStream, merged
from ..model.transforms import Transform
from ..system import atomic
from ..system.addresses import Address, Place
from ..system.errors import FormatError, OutputError, SparklodError
from ..system.stdio import DASH, name_of
from .local_files import reason_of
from .reading import opened, readable

#: Makes the bytes of a scratch file.
Pieces = Callable[[], Iterable[bytes]]


@contextlib.contextmanager
def open_stream(
    path: Place, *, scratch: Path | None = None, keep: bool = False, threads: int = 1
) -> Iterator[SceneStream]:
    """Yield the splats of a file of any known format without a tree, block by block.

    Only its header is read now. Each read of the stream has the file for itself, so that several threads may read.
    Columns that lie one after the other (SPZ, SOG), and text, are unpacked once, when splats are first read; see
    docs/formats.md for the room that takes.

    Args:
        scratch: folder for what is unpacked; None for one of the system's temporary files.
        keep: leave what is unpacked in `scratch`, where the same file is found unpacked the next time, by other
            processes, too; whoever owns the folder removes it. The stream can be pickled then.

    Raises:
        HasTreeError: the file is a tree.
        FormatError: as `io.read_scene`. What is wrong behind the header is raised by reading; so is `OutputError`,
            where there is no room for what is unpacked.
        ValueError: `keep` without `scratch`.
    """
    if keep and scratch is None:
        raise ValueError("keep needs a scratch folder")
    store: _Store = _Folder(scratch) if keep and scratch is not None else _Unnamed(scratch)
    try:
        source = _Source(path, store, threads)
        with source.borrowed() as stream:
            found = stream
        yield dataclasses.replace(found, read=_ReadAnew(source, found.count, found.sh_degree))
    finally:
        close_idle(lambda key: isinstance(key, _Key) and (key.store, key.path) == (store.name, path))
        store.close()


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
def open_streams(
    files: Sequence[PlacedFile], *, scratch: Path | None = None, keep: bool = False, threads: int = 1
) -> Iterator[SceneStream]:
    """Yield the splats of several files, each where it stands, as those of one scene; see `streams.merged`.

    Nothing is kept open between reads, and the header of a file that is named twice is read once.

    Raises:
        HasTreeError, FormatError, ValueError: as `open_stream`; names the file.
    """
    names = dict.fromkeys(each.file for each in files)
    streams = {file: _again(file, scratch, keep, threads) for file in names}
    yield merged([Placed(streams[each.file], name_of(each.file), each.transform) for each in files])


def _again(file: Place, scratch: Path | None, keep: bool, threads: int) -> SceneStream:
    """Return the stream of a file that need not stay open."""
    try:
        with open_stream(file, scratch=scratch, keep=keep, threads=threads) as stream:
            once = functools.partial(_read_once, file, scratch, threads)
            return stream if keep else dataclasses.replace(stream, read=once)
    except SparklodError as error:
        raise type(error)(f"{name_of(file)}: {error}") from None


def _read_once(path: Place, scratch: Path | None, threads: int, start: int, stop: int) -> Iterator[Splats]:
    with open_stream(path, scratch=scratch, threads=threads) as stream:
        yield from stream.read(start, stop)


class _Store(Protocol):
    """Storage of one unpacked file.

    Attributes:
        name: tells it from others.
    """

    @property
    def name(self) -> Hashable: ...

    def file(self, path: Place, pieces: Pieces) -> contextlib.AbstractContextManager[BinaryIO]:
        """Return what has been unpacked of a file; `pieces` are written first if they have not been."""

    def close(self) -> None:
        """Remove it, unless it is to stay."""


@dataclass
class _Unnamed:
    """A file without a name, which is gone with this process at the latest."""

    folder: Path | None
    _file: BinaryIO | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def name(self) -> Hashable:
        return id(self)

    def file(self, path: Place, pieces: Pieces) -> contextlib.AbstractContextManager[BinaryIO]:
        with self._lock:
            if self._file is None:
                with _room(self.folder), contextlib.ExitStack() as stack:
                    file: BinaryIO = stack.enter_context(tempfile.TemporaryFile(prefix="sparklod-", dir=self.folder))
                    for piece in pieces():
                        file.write(piece)
                    file.flush()
                    stack.pop_all()
                self._file = file
        return contextlib.nullcontext(self._file)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


#: One thread of a process unpacks a file, and the others wait.
_LOCKS: dict[Path, threading.Lock] = {}


@dataclass(frozen=True)
class _Folder:
    """A folder of such files, each named after what it was unpacked from, which appear whole or not at all."""

    folder: Path

    @property
    def name(self) -> Hashable:
        return self.folder

    def file(self, path: Place, pieces: Pieces) -> contextlib.AbstractContextManager[BinaryIO]:
        target = self.folder / f"{_digest(path)}.unpacked"
        with _LOCKS.setdefault(target, threading.Lock()), _room(self.folder):
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                atomic.write(target, pieces(), overwrite=True)
            return target.open("rb")

    def close(self) -> None:
        pass


def _digest(path: Place) -> str:
    """Return a name for this version of a file."""
    if isinstance(path, Address):
        parts: tuple[Any, ...] = (path.url, path.version())
    else:
        status = None if path == DASH else path.stat()
        parts = (path.absolute(), *((status.st_size, status.st_mtime_ns) if status else ()))
    return hashlib.sha256("\n".join(map(str, parts)).encode("utf-8", "surrogateescape")).hexdigest()[:32]


@contextlib.contextmanager
def _room(folder: Path | None) -> Iterator[None]:
    """Turn an `OSError` of the body into an `OutputError`."""
    try:
        yield
    except OSError as error:
        where = folder or tempfile.gettempdir()
        raise OutputError(f"cannot write to the scratch folder {where}: {reason_of(error)}") from None


class _Key(NamedTuple):
    """Key that identifies an opened file, see `idle.borrowed`."""

    store: Hashable
    path: Place
    version: str
    threads: int


@dataclass(frozen=True)
class _Source:
    """A file, and what opens it."""

    path: Place
    store: _Store
    threads: int

    @contextlib.contextmanager
    def borrowed(self) -> Iterator[SceneStream]:
        """Yield the stream of the file, which nobody else reads as long as the body runs."""
        with readable():
            key = _Key(self.store.name, self.path, _digest(self.path), self.threads)
            with borrowed(key, self._opened) as stream:
                yield stream

    def _opened(self) -> Opened:
        unpacked: list[BinaryIO] = []

        def scratch(pieces: Pieces) -> BinaryIO:
            def readable_pieces() -> Iterator[bytes]:
                with readable():
                    yield from pieces()

            if not unpacked:
                unpacked.append(closing.enter_context(self.store.file(self.path, readable_pieces)))
            return unpacked[0]

        closing = contextlib.ExitStack()
        with contextlib.ExitStack() as after_an_error:
            after_an_error.enter_context(closing)
            file, form, more = closing.enter_context(opened(self.path))
            source = Source(file, scratch=scratch, threads=self.threads, **more)
            content: Content = form.codec().open_content(source)
            stream = content.stream(self.threads)
            after_an_error.pop_all()
        return closing, stream


@dataclass(frozen=True)
class _ReadAnew:
    """`SceneStream.read` of a file that is opened anew."""

    source: _Source
    count: int
    sh_degree: int

    def __call__(self, start: int, stop: int) -> Iterator[Splats]:
        with self.source.borrowed() as stream:
            if (stream.count, stream.sh_degree) != (self.count, self.sh_degree):
                raise FormatError("it was changed while it was read; start again")
            yield from stream.read(start, stop)


#: An open file, and the stream of it.
Opened = tuple[contextlib.ExitStack, SceneStream]

#: Files that wait at most: a palette takes up to 12 MB, and each is an open file. Chosen.
MOST = 4

_LOCK = threading.Lock()

#: By what tells them apart, the one that waits longest first; one that is in use is not among them.
_IDLE: list[tuple[Hashable, Opened]] = []


@contextlib.contextmanager
def borrowed(key: Hashable, opened: Callable[[], Opened]) -> Iterator[SceneStream]:
    """Yield a stream that nobody else reads meanwhile: one that waits, or else a new one. It waits afterwards."""
    found = _taken(key) or opened()
    sound = False
    try:
        yield found[1]
        sound = True
    except GeneratorExit:  # whoever reads wants no more
        sound = True
        raise
    finally:
        if sound:
            _put(key, found)
        else:
            found[0].close()


def close_idle(matches: Callable[[Hashable], bool] = lambda key: True) -> None:
    """Close the files that wait, or those whose keys match."""
    with _LOCK:
        closing = [item for item in _IDLE if matches(item[0])]
        _IDLE[:] = [item for item in _IDLE if not matches(item[0])]
    for _, (stack, _) in closing:
        stack.close()


def _taken(key: Hashable) -> Opened | None:
    with _LOCK:
        place = next((place for place, (other, _) in enumerate(_IDLE) if other == key), None)
        return None if place is None else _IDLE.pop(place)[1]


def _put(key: Hashable, opened: Opened) -> None:
    with _LOCK:
        _IDLE.append((key, opened))
        closing = _IDLE.pop(0)[1] if len(_IDLE) > MOST else None
    if closing is not None:
        closing[0].close()


atexit.register(close_idle)
if hasattr(os, "register_at_fork"):  # a child shares the position in a file with its parent
    os.register_at_fork(after_in_child=_IDLE.clear)
