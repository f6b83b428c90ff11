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
from .opening import open_splats, opened, readable

if TYPE_CHECKING:
    from ..codecs.options import WriteOptions
    from ..model.scene import DetailScene, TileScene
    from ..model.transforms import Transform

#: Files of one scene that stay open, and files that are opened again and stay open: each has a palette of up to 12 MB.
#: Chosen.
MOST = 4

_LOCK = threading.Lock()


@dataclass(frozen=True, eq=False)
class Merged:
    """Several files without trees that are one scene, and the transform of each; a file may be named more than once."""

    files: tuple[tuple[Place, Transform], ...]

    @classmethod
    def of(cls, places: Sequence[Place]) -> Merged:
        """Return files where their own coordinates put them."""
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
    """Return the same source for processes whose working folders are others."""
    if not isinstance(source, Merged):
        return absolute(source)
    return Merged(tuple((absolute(file), transform) for file, transform in source.files))


def placement_of(source: Source) -> dict[str, Any]:
    """Return where the files of a source stand, as a recipe has it; nothing for a single file."""
    if not isinstance(source, Merged):
        return {}
    # The rotation row by row, the scale, the translation.
    numbers = ((*each.rotation.flat, each.scale, *each.translation) for _, each in source.files)
    return {"merged": [[*map(float, each)] for each in numbers]}


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


def read_stored(path: Place, options: WriteOptions) -> tuple[Any, WriteOptions]:
    """Read the codes of a file whose format can hold a tree, so that its leaves can be written again bit for bit.

    Returns:
        the codes, for `Encoder.keeping`, and the options, which have the file's value where they leave a choice open.
    """
    with opened(path) as (source, form):
        found: tuple[Any, WriteOptions] = form.codec().stored(source, options)
    return found


def read_parts(path: Place, *, threads: int = 1, progress: Progress = silent) -> DetailScene | TileScene | None:
    """Read a scene with all its detail levels or tiles; None if its format has neither. Raises as `read_scene`."""
    with opened(path) as (source, form):
        if form.parts is None:
            return None
        scene: DetailScene | TileScene = form.codec().decode_parts(
            source.file, threads=threads, progress=progress, open_companion=source.open_companion
        )
    return scene


@contextlib.contextmanager
def open_reader(source: Source, *, scratch: Path | None = None, threads: int = 1) -> Iterator[Reader]:
    """Open a file of any known format, or several as one scene, see `merging.merged`.

    Only its header is read now. Any range of splats can be read until the end, on several threads. Columns that lie one
    after the other (SPZ, SOG), and text, are unpacked once, when a block is first read; see docs/formats.md for the
    size of the unpacked file.

    Args:
        scratch: folder for the unpacked file, which stays there, so that other processes find it; the owner of the
            folder removes it. The reader can be pickled then. None for one of the system's temporary files.

    Raises:
        FormatError: as `io.read_scene`. Reading raises errors behind the header, and `OutputError` if there is no room
            for the unpacked file. Of several files, errors name the file.
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
    """Return size and time of a file, or the version of an address; () if that takes a request without need."""
    if path == DASH or (isinstance(path, Address) and scratch is None):
        return ()
    if isinstance(path, Address):
        return (path.version(),)
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _opened(
    path: Place, version: tuple[Any, ...], folder: Path | None, threads: int, closing: contextlib.ExitStack
) -> Reader:
    """Open a file, and later its unpacked rows, until `closing` closes them."""
    lock, unpacked = threading.Lock(), list[OpenFile]()

    def scratch(pieces: Callable[[], Iterable[bytes]]) -> OpenFile:
        with lock:
            if not unpacked:
                try:
                    if folder is None:
                        file = _temporary(pieces)
                    else:
                        parts = (path.url if isinstance(path, Address) else path.absolute(), *version)
                        text = "\n".join(map(str, parts)).encode("utf-8", "surrogateescape")
                        file = _kept(folder / f"{hashlib.sha256(text).hexdigest()[:32]}.unpacked", pieces)
                except OSError as error:
                    where = folder or tempfile.gettempdir()
                    raise OutputError(f"cannot write to the scratch folder {where}: {reason_of(error)}") from None
                unpacked.append(OpenFile(closing.enter_context(file)))
        return unpacked[0]

    source, form = open_splats(path, closing, scratch, threads)
    reader: Reader = form.codec().open_content(source)
    return dataclasses.replace(reader, threads=threads)


def _temporary(pieces: Callable[[], Iterable[bytes]]) -> BinaryIO:
    """Write a file without a name, which the system removes."""
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
    """Write a file unless it exists; it appears whole or not at all."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, _readable(pieces), overwrite=True)
    return target.open("rb")


def _readable(pieces: Callable[[], Iterable[bytes]]) -> Iterator[bytes]:
    with readable():
        yield from pieces()


@dataclass(frozen=True, eq=False)
class _FillFromFile:
    """`Reader.fill` of a file, which is opened again in another process, after it was closed, and if it changed."""

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
    """Open a file; it is closed when it is not read and `MOST` others have been opened since."""
    closing = contextlib.ExitStack()
    with contextlib.ExitStack() as after_an_error:
        after_an_error.enter_context(closing)
        reader = _opened(path, version, scratch, threads, closing)
        after_an_error.pop_all()
    weakref.finalize(reader, closing.close)
    return reader


def _merged(source: Merged, scratch: Path | None, threads: int, closing: contextlib.ExitStack) -> Reader:
    """Open several files; the header of a file that is named twice is read once."""
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
