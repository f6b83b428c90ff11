"""The chunks of a folder of Streamed SOG: SOG scenes, of which some splats are read to some rows."""

from __future__ import annotations

import contextlib
import posixpath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from ...model.splats import COLUMNS, Splats
from ...support.errors import FormatError
from ...support.parallel import ordered_map
from ...support.progress import Progress, silent
from ...support.untrusted import quoted_value
from ..content import OpenCompanion, Source
from ..file_names import MANIFEST
from ..sog import codec as sog
from ..validation import error_of


@dataclass(frozen=True)
class Piece:
    """Run of splats of a chunk: the first, how many, and the row that the first of them gets."""

    start: int
    count: int
    row: int


@dataclass(frozen=True)
class Chunk:
    """Chunk, as far as its meta.json tells, and the pieces of it to read.

    Attributes:
        name: path of its meta.json.
        count: all its splats.
        sh_degree, antialiased: as of a scene.
        bytes: of all its files.
        pieces: to read.
    """

    name: str
    count: int
    sh_degree: int
    antialiased: bool
    bytes: int
    pieces: tuple[Piece, ...]

    @property
    def rows(self) -> int:
        """Number of splats in the pieces."""
        return sum(piece.count for piece in self.pieces)


def open_chunk(open_companion: OpenCompanion | None, name: str, pieces: Sequence[Piece] | None, row: int = 0) -> Chunk:
    """Read the meta.json of a chunk.

    Raises:
        FormatError: it is no SOG; names it.
    """
    with _opened(open_companion, name) as source:
        content = sog.open_content(source)
    return Chunk(
        name,
        content.count,
        content.sh_degree,
        content.antialiased,
        content.header["bytes"],
        (Piece(0, content.count, row),) if pieces is None else tuple(pieces),
    )


def read_pieces(
    open_companion: OpenCompanion | None,
    chunks: Sequence[Chunk],
    out: Splats,
    threads: int = 1,
    progress: Progress = silent,
    first_row: int = 0,
) -> None:
    """Fill rows with the pieces of chunks, several chunks at a time, on several threads.

    Args:
        chunks: whose pieces together have every row of `out` once.
        out: SH coefficients that a chunk does not have become 0.
        first_row: that the first row of `out` has in the pieces.

    Raises:
        FormatError: a chunk is broken; names it.
    """
    together = min(threads, len(chunks))

    def work(chunk: Chunk) -> int:
        with _opened(open_companion, chunk.name) as source:
            splats = sog.open_content(source).scene(threads=max(1, threads // together)).splats
        if (len(splats), splats.sh_degree) != (chunk.count, chunk.sh_degree):
            raise FormatError(f"{quoted_value(chunk.name)} was changed while it was read; start again")
        for piece in chunk.pieces:
            _copy(out, piece, piece.row - first_row, splats)
        return chunk.rows

    done = 0
    for rows in ordered_map(work, chunks, together):
        done += rows
        progress("reading", done, len(out), "splat")


def _copy(out: Splats, piece: Piece, row: int, splats: Splats) -> None:
    """Copy a piece of a chunk to rows."""
    source, target = slice(piece.start, piece.start + piece.count), slice(row, row + piece.count)
    for name in COLUMNS:
        column = getattr(out, name)
        if name == "sh":
            has = splats.sh.shape[1]
            column[target, has:] = 0
            column[target, :has] = splats.sh[source]
        else:
            column[target] = getattr(splats, name)[source]


@contextlib.contextmanager
def _opened(open_companion: OpenCompanion | None, name: str) -> Iterator[Source]:
    """Open the meta.json of a chunk, and what opens the files beside that; errors of the body name the chunk."""
    if open_companion is None:
        raise FormatError(f"{MANIFEST} names {quoted_value(name)}, but other files cannot be opened here")
    folder = posixpath.dirname(name)

    def images(other: str) -> BinaryIO:
        return open_companion(f"{folder}/{other}" if folder else other)

    try:
        opened = open_companion(name)
    except FormatError as error:  # which names it
        raise error_of("streamed-sog.chunk-files", str(error)) from None
    with opened as file:
        try:
            yield Source(file, images)
        except FormatError as error:
            raise error_of("streamed-sog.chunk-files", f"{quoted_value(name)}: {error}") from None
