"""RAD files in parts: the header alone, one chunk, or chunk by chunk where a file may be larger than memory."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from ..codecs.formats import RAD
from ..codecs.rad.codec import RadChunk, read_chunk
from ..codecs.rad.rad_header import RadHeader, header_violations, read_header
from ..codecs.rad.rad_reader import RadReader, decoded_bytes, file_of
from ..codecs.reader import OpenFile
from ..codecs.rules import check_rules
from ..model.file_coding import FileCoding
from ..model.lod_tree import LodTree
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..system.errors import UnreadableError, reason_of
from ..system.machine import available_memory
from .local_files import open_named
from .reading import opened

#: Files whose decoded columns take more bytes than this, or than this share of the free memory, are read chunk by
#: chunk: computed values take as much again, and chunk by chunk is no slower
#: (docs/decisions/14-cuts.md).
AT_ONCE, SHARE = 1 << 28, 0.25


@dataclass(frozen=True, eq=False)
class RadFile:
    """A RAD file; none of its chunks stays in memory."""

    path: Path
    header: RadHeader
    _reader: RadReader = field(repr=False)

    @classmethod
    def open(cls, path: Path) -> RadFile | None:
        """Read the header of a file, and its palette; None for another format. Raises as `read_rad_header`."""
        with opened(path) as (source, form):
            return cls.of(path, source) if form.name == RAD else None

    @classmethod
    def of(cls, path: Path, source: OpenFile) -> RadFile:
        """Read the header of an open file, and its palette; the file may be closed afterwards. Raises as `open`."""
        reader = RadReader.open(source.file, source.open_companion)
        return cls(path, reader.header, reader)

    @property
    def scene(self) -> Scene:
        """Scene as it is known before any chunk is read: without splats, and without its tree."""
        header = self.header
        return Scene(
            Splats.empty(0, header.max_sh),
            antialiased=header.noted.antialiased,
            format=header.format,
            notes=header.noted.problems,
            header=self._reader.facts,
            chunk_bytes=tuple(entry.bytes for entry in header.chunks),
            up=header.noted.up,
        )

    @property
    def fits(self) -> bool:
        """Whether it is small enough to be read at once."""
        free = available_memory()
        return decoded_bytes(self.header) <= (AT_ONCE if free is None else min(AT_ONCE, SHARE * free))

    def chunks(
        self, columns: Collection[str], *, thorough: bool, threads: int
    ) -> Iterator[tuple[int, Splats, LodTree | None]]:
        """Yield all chunks in order: the index of the first splat of each, its splats, and its nodes if it has a tree.

        Args:
            thorough: unpack the other columns, too, which finds corrupt data.
        """
        with self._reopened() as reader:
            yield from reader.chunks(columns, thorough=thorough, threads=threads)

    def chunk(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        """Return one chunk and its coding; only these columns are unpacked. Several threads may call this."""
        with self._reopened() as reader:
            return reader.chunk(number, columns)

    @contextlib.contextmanager
    def _reopened(self) -> Iterator[RadReader]:
        with opened(self.path) as (source, _):
            yield self._reader.reopened(source.file, source.open_companion)


def read_rad_header(path: Path) -> RadHeader:
    """Read the header of a RAD file, whose chunks need not be there; raises `FormatError` if it breaks a fatal rule."""
    with _opened_plain(path) as file:
        return _header(file)


def read_rad_chunk(path: Path, number: int, *, palette: FloatArray | None = None) -> RadChunk:
    """Read the header of a RAD file, and one chunk of it.

    Args:
        palette: that of the first chunk, see `codecs.rad.codec.read_chunk`.

    Raises:
        FormatError: the header or the chunk cannot be read, or is broken.
        ValueError: there is no such chunk.
    """
    with _opened_plain(path) as file:
        header = _header(file)
        if not 0 <= number < len(header.chunks):
            raise ValueError(f"number is {number}; its chunks are 0 to {len(header.chunks) - 1}")
        entry = header.chunks[number]
        with file_of(entry, file, functools.partial(open_named, path)) as source:
            return read_chunk(source, entry, header, palette)


@contextlib.contextmanager
def _opened_plain(path: Path) -> Iterator[BinaryIO]:
    try:
        if path.exists() and not path.is_file():
            raise UnreadableError("cannot be read: it is a directory, a pipe or a device")
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise UnreadableError(f"cannot be read: {reason_of(error)}") from None


def _header(file: BinaryIO) -> RadHeader:
    header = read_header(file)
    check_rules(header_violations(header))
    return header
