"""`RadFile`, a RAD file that is read chunk by chunk, since it may be larger than memory."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ..codecs.rad.by_chunk import ByChunk, bytes_decoded
from ..codecs.rad.codec import name_of
from ..codecs.rad.records import RadHeader
from ..model.lod_tree import LodTree
from ..model.scene import FileCoding
from ..model.splats import Splats
from ..support.machine import available_memory
from .reading import opened

#: Name of the format in `codecs.formats`.
FORMAT = "RAD"

#: Files whose decoded columns take more bytes than this, or than this share of the free memory, are read chunk by
#: chunk: what is computed of them takes as much again, and chunk by chunk is no slower
#: (docs/decisions/2026-11-22-files-larger-than-memory.md).
AT_ONCE, SHARE = 1 << 28, 0.25


@dataclass(frozen=True, eq=False)
class RadFile:
    """A RAD file; none of its chunks stays in memory.

    Attributes:
        path: of the file.
        header: of the file.
        about: the numbers that `Scene.header` has.
    """

    path: Path
    header: RadHeader
    about: Mapping[str, int]
    _chunks: ByChunk = field(repr=False)

    @classmethod
    def open(cls, path: Path) -> RadFile | None:
        """Reads the header of a file, and its palette; None where the file is of another format.

        Raises:
            FormatError: it cannot be read, or breaks a promise without which its chunks cannot be.
        """
        with _opened(path) as found:
            if found is None:
                return None
            chunks = ByChunk.of(*found)
        return cls(path, chunks.header, chunks.facts, chunks)

    @property
    def format(self) -> str:
        """As `Scene.format`."""
        return name_of(self.header)

    @property
    def chunk_bytes(self) -> tuple[int, ...]:
        """Sizes of the chunks in the file."""
        return tuple(entry.bytes for entry in self.header.chunks)

    @property
    def fits(self) -> bool:
        """Whether it is small enough to be read at once."""
        free = available_memory()
        return bytes_decoded(self.header) <= (AT_ONCE if free is None else min(AT_ONCE, SHARE * free))

    def chunks(
        self, columns: Collection[str], *, thorough: bool, threads: int
    ) -> Iterator[tuple[int, Splats, LodTree | None]]:
        """All chunks in order: the index of the first splat of each, its splats, and its nodes where there is a tree.

        Args:
            columns: of `Splats`; the others are 0.
            thorough: unpack the others, too, which finds what is corrupt.
            threads: to decode with.

        Raises:
            FormatError: a chunk is damaged.
        """
        with _opened(self.path) as found:
            assert found is not None
            yield from self._chunks.read_all(*found, columns, thorough=thorough, threads=threads)

    def chunk(self, number: int, columns: Collection[str]) -> tuple[Splats, LodTree | None, FileCoding]:
        """One chunk and its coding; only these columns are unpacked. Several threads may ask.

        Raises:
            FormatError: it is damaged.
        """
        with _opened(self.path) as found:
            assert found is not None
            return self._chunks.read(number, *found, columns, thorough=False)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, Any] | None]:
    """A RAD file and what opens the files beside it; None for a file of another format."""
    with opened(path) as (file, form, more):
        yield (file, more["beside"]) if form.name == FORMAT else None
