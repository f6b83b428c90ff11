"""The chunks of a folder of Streamed SOG: SOG scenes, of which some splats are wanted at some rows."""

from __future__ import annotations

import contextlib
import posixpath
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from ...model.scene import Scene
from ...model.splats import COLUMNS, Splats
from ...model.streams import SceneStream
from ...support.errors import FormatError
from ...support.parallel import ordered_map
from ...support.progress import Progress
from ...support.units import count_of
from ...support.untrusted import quoted_value
from ..promises import error_of
from ..sog import codec as sog
from .names import MANIFEST

#: Opens a file by its path below the folder of the manifest.
Beside = Callable[[str], BinaryIO]


@dataclass(frozen=True)
class Piece:
    """Some splats of a chunk: the first, how many, and the row that the first of them gets."""

    start: int
    count: int
    row: int


@dataclass(frozen=True)
class Chunk:
    """A chunk, as far as its meta.json tells, and what is wanted of it.

    Attributes:
        name: path of its meta.json.
        count: all its splats.
        sh_degree, antialiased: as of a scene.
        bytes: of all its files.
        pieces: what is wanted.
    """

    name: str
    count: int
    sh_degree: int
    antialiased: bool
    bytes: int
    pieces: tuple[Piece, ...]

    @property
    def rows(self) -> int:
        """How many splats are wanted."""
        return sum(piece.count for piece in self.pieces)


def open_chunk(beside: Beside | None, name: str, pieces: Sequence[Piece] | None, row: int = 0) -> Chunk:
    """A chunk whose meta.json is read.

    Args:
        beside: opens files.
        name: path of the meta.json.
        pieces: what is wanted; None for all of it.
        row: that the first splat gets where all are wanted.

    Raises:
        FormatError: it is no SOG; names it.
    """

    def never(pieces: object) -> BinaryIO:
        raise AssertionError("only the header is read")

    with _opened(beside, name) as (file, images):
        found: SceneStream = sog.stream(file, scratch=never, beside=images)
    return Chunk(
        name,
        found.count,
        found.sh_degree,
        found.antialiased,
        found.header["bytes"],
        (Piece(0, found.count, row),) if pieces is None else tuple(pieces),
    )


def check_count(chunk: Chunk, count: int) -> None:
    """Raises `FormatError` where a chunk has another number of splats than its runs."""
    if chunk.count != count:
        has = count_of(chunk.count, "splat")
        text = f"{quoted_value(chunk.name)} has {has}, but its runs in {MANIFEST} have {count:,}"
        raise error_of("streamed-sog.runs", text)


def filled(beside: Beside | None, chunks: Sequence[Chunk], sh_degree: int, threads: int, progress: Progress) -> Splats:
    """The wanted splats of chunks, each at its row; several chunks at a time, on several threads.

    Args:
        beside: opens files.
        chunks: whose pieces together have every row once.
        sh_degree: of the result; coefficients that a chunk does not have are 0.
        threads: to decode with.
        progress: called when a chunk is decoded.

    Raises:
        FormatError: a chunk is broken; names it.
    """
    count = sum(chunk.rows for chunk in chunks)
    out = Splats.empty(count, sh_degree)
    together = min(threads, len(chunks))

    def work(chunk: Chunk) -> int:
        with _opened(beside, chunk.name) as (file, images):
            scene: Scene = sog.decode(file, threads=max(1, threads // together), beside=images)
        if (len(scene), scene.splats.sh_degree) != (chunk.count, chunk.sh_degree):
            raise FormatError(f"{quoted_value(chunk.name)} was changed while it was read; start again")
        for piece in chunk.pieces:
            _copy(out, piece, scene.splats)
        return chunk.rows

    done = 0
    for rows in ordered_map(work, chunks, together):
        done += rows
        progress("reading", done, count, "splat")
    return out


def _copy(out: Splats, piece: Piece, splats: Splats) -> None:
    """Copies a piece of a chunk to its rows."""
    source, target = slice(piece.start, piece.start + piece.count), slice(piece.row, piece.row + piece.count)
    for name in COLUMNS:
        column = getattr(out, name)
        if name == "sh":
            has = splats.sh.shape[1]
            column[target, has:] = 0
            column[target, :has] = splats.sh[source]
        else:
            column[target] = getattr(splats, name)[source]


@contextlib.contextmanager
def _opened(beside: Beside | None, name: str) -> Iterator[tuple[BinaryIO, Beside]]:
    """The meta.json of a chunk, and what opens the files beside that; errors of the body name the chunk."""
    if beside is None:
        raise FormatError(f"{MANIFEST} names {quoted_value(name)}, but other files cannot be opened here")
    folder = posixpath.dirname(name)

    def images(other: str) -> BinaryIO:
        return beside(f"{folder}/{other}" if folder else other)

    try:
        opened = beside(name)
    except FormatError as error:  # which names it
        raise error_of("streamed-sog.chunk-files", str(error)) from None
    with opened as file:
        try:
            yield file, images
        except FormatError as error:
            raise error_of("streamed-sog.chunk-files", f"{quoted_value(name)}: {error}") from None
