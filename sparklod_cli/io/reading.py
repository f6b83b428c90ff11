"""Reads scenes of files of any format, alone or merged: whole, in parts, or block by block in several processes."""

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
from typing import TYPE_CHECKING, Any, BinaryIO

from ..codecs.reader import OpenFile, Reader, RowBuffer
from ..model.scene import Scene
from ..model.splats import COLUMNS
from ..system.addresses import Address, Place, absolute
from ..system.errors import FormatError, OutputError, naming, reason_of
from ..system.output import write_atomically
from ..system.progress import Progress, silent
from ..system.stdio import DASH, name_of
from ..system.units import count_of
from .files import open_splats, opened, readable

if TYPE_CHECKING:
    from ..model.instances import DetailScene, TileScene
    from ..model.transforms import Transform

#: Files of one scene that stay open, and files that are opened again and stay open: each has a palette of up to 12 MB.
#: Chosen.
MOST = 4

_LOCK = threading.Lock()


@dataclass(frozen=True, eq=False)
class Merged:
    """Several files without trees that are one scene, each with its transform; a file may occur more than once."""

    files: tuple[tuple[Place, Transform], ...]

    @classmethod
    def of(cls, places: Sequence[Place]) -> Merged:
        """Merge files where their own coordinates put them."""
        from ..model.transforms import Transform

        return cls(tuple((place, Transform()) for place in places))

    def __str__(self) -> str:
        return count_of(len(self.files), "file")


#: A file, which may be standard input (-), or several.
Source = Place | Merged


def places_of(source: Source) -> list[Place]:
    """Return the files of a source, in order."""
    return [file for file, _ in source.files] if isinstance(source, Merged) else [source]


def absolute_source(source: Source) -> Source:
    """Return the source with absolute paths, for processes with other working folders."""
    if not isinstance(source, Merged):
        return absolute(source)
    return Merged(tuple((absolute(file), transform) for file, transform in source.files))


def read_scene(
    path: Place,
    *,
    columns: Collection[str] = COLUMNS,
    threads: int = 1,
    progress: Progress = silent,
    validate: bool = True,
) -> Scene:
    """Read a splat file of any known format, recognised by its content, or else by its suffix.

    Args:
        path: of a file, or of a folder that holds an unpacked SOG or a Streamed SOG; - is standard input.
        columns: of `Splats` to read; the others may be 0.
        validate: refuse a broken tree.

    Raises:
        FormatError: it is not a file, empty, of no known format, or broken.
    """
    with open_reader(path, threads=threads) as reader:
        return reader.scene(columns=columns, progress=progress, validate=validate)


def read_parts(path: Place, *, threads: int = 1, progress: Progress = silent) -> DetailScene | TileScene | None:
    """Read a scene with all its detail levels or tiles; return None if its format has neither."""
    with opened(path) as (source, form):
        if form.parts is None:
            return None
        scene: DetailScene | TileScene = form.codec().decode_parts(
            source.file, threads=threads, progress=progress, open_companion=source.open_companion
        )
    return scene


@contextlib.contextmanager
def open_reader(source: Source, *, scratch: Path | None = None, threads: int = 1) -> Iterator[Reader]:
    """Open a file of any known format, or several as one scene (see `merging.merged`), and read only the header.

    Several threads may read any range of splats until the context ends. Columns that lie one after the other (SPZ, SOG)
    and text are unpacked to a file when a block is first read; see docs/formats.md for its size.

    Args:
        scratch: folder for the unpacked file, which stays there for other processes, so that the reader can be pickled;
            the owner of the folder removes it. None for a temporary file of the system.

    Raises:
        FormatError: as `read_scene`; reading may raise further ones, and an `OutputError` without room for the unpacked
            file. With several files, errors name the file.
        HasTreeError: one of several files has a tree.
    """
    with contextlib.ExitStack() as closing:
        if isinstance(source, Merged):
            yield _merged(source, scratch, threads, closing)
            return
        with readable():
            version = _version(source, scratch)
            reader = _opened(source, version, scratch, threads, closing)
        fill = _FillFromFile(source, version, scratch, threads, reader.count, reader.sh_degree, reader)
        yield dataclasses.replace(reader, fill=fill)


def _version(path: Place, scratch: Path | None) -> tuple[Any, ...]:
    """Return size and date of a file, or the version at an address; () where nothing compares it."""
    if path == DASH or (isinstance(path, Address) and scratch is None):
        return ()
    if isinstance(path, Address):
        return (path.version(),)
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _opened(
    path: Place, version: tuple[Any, ...], folder: Path | None, threads: int, closing: contextlib.ExitStack
) -> Reader:
    """Open a file, and when it is first needed its unpacked file, until `closing` closes them."""
    lock, unpacked = threading.Lock(), list[OpenFile]()

    def scratch(pieces: Callable[[], Iterable[bytes]]) -> OpenFile:
        with lock:
            if not unpacked:
                try:
                    if folder is None:
                        file = _temporary(_readable(pieces))
                    else:
                        parts = (path.url if isinstance(path, Address) else path.absolute(), *version)
                        text = "\n".join(map(str, parts)).encode("utf-8", "surrogateescape")
                        target = folder / f"{hashlib.sha256(text).hexdigest()[:32]}.unpacked"
                        if not target.exists():
                            folder.mkdir(parents=True, exist_ok=True)
                            write_atomically(target, _readable(pieces), overwrite=True)
                        file = target.open("rb")
                except OSError as error:
                    where = folder or tempfile.gettempdir()
                    raise OutputError(f"cannot write to the scratch folder {where}: {reason_of(error)}") from None
                unpacked.append(OpenFile(closing.enter_context(file)))
        return unpacked[0]

    source, form = open_splats(path, closing, scratch, threads)
    reader: Reader = form.codec().open_content(source)
    return dataclasses.replace(reader, threads=threads)


def _temporary(pieces: Iterable[bytes]) -> BinaryIO:
    """Write a file without a name, which the system removes when it is closed."""
    file: BinaryIO = tempfile.TemporaryFile(prefix="sparklod-")  # noqa: SIM115
    try:
        file.writelines(pieces)
        file.flush()
    except BaseException:
        file.close()
        raise
    return file


def _readable(pieces: Callable[[], Iterable[bytes]]) -> Iterator[bytes]:
    """Yield pieces that are made from an input, so that its `OSError` is not taken for one of the unpacked file."""
    with readable():
        yield from pieces()


@dataclass(frozen=True, eq=False)
class _FillFromFile:
    """`Reader.fill` that opens its file again in another process, after the file was closed, or if it was changed."""

    path: Place
    version: tuple[Any, ...]
    scratch: Path | None
    threads: int
    count: int
    sh_degree: int
    reader: Reader | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, target: RowBuffer, threads: int, progress: Progress) -> None:
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
    """Open a file that stays open until `MOST` others have been opened since and its reader is no longer used."""
    closing = contextlib.ExitStack()  # to which the unpacked file is added later
    try:
        reader = _opened(path, version, scratch, threads, closing)
    except BaseException:
        closing.close()
        raise
    weakref.finalize(reader, closing.close)
    return reader


def _merged(source: Merged, scratch: Path | None, threads: int, closing: contextlib.ExitStack) -> Reader:
    """Open several files; a file that occurs more than once is opened once."""
    from ..codecs.merging import Placed, merged  # what a single file does without

    closing.callback(_opened_again.cache_clear)
    readers = dict[Place, Reader]()
    for file in dict.fromkeys(places_of(source)):
        with naming(name_of(file)), contextlib.ExitStack() as own:
            reader = own.enter_context(open_reader(file, scratch=scratch, threads=threads))
            reader.check_plain()
            if len(readers) < MOST:
                closing.push(own.pop_all())
            else:  # it is opened again when it is read
                assert isinstance(reader.fill, _FillFromFile)
                reader = dataclasses.replace(reader, fill=dataclasses.replace(reader.fill, reader=None))
            readers[file] = reader
    return merged([Placed(readers[file], name_of(file), transform) for file, transform in source.files])
