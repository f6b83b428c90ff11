"""The read contract of all codecs: `open_content` reads a header, and its `Content` fills columns with any splats.

Whole scenes, chosen columns and streams are generic wrappers of `Content.fill`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, Protocol

import numpy as np

from ..model import streams
from ..model.lod_tree import LodTree
from ..model.scene import PLAIN, FileCoding, Scene, facts_of
from ..model.splats import COLUMNS, Splats
from ..system.errors import HasTreeError
from ..system.progress import Progress, silent
from .validation import with_valid_tree

#: Opens a file of these bytes, which are made only if they have not been before; for formats whose splats do not lie
#: one after the other. Whoever passes it closes the file.
Scratch = Callable[[Callable[[], Iterable[bytes]]], BinaryIO]

#: Opens a file that another one names; raises `FormatError` where it cannot.
OpenCompanion = Callable[[str], BinaryIO]


@dataclass(frozen=True, eq=False)
class Source:
    """Open file for a codec.

    Attributes:
        file: open for reading, at its beginning.
        open_companion: opens the files that it names; None if there are none to open.
        scratch: keeps what has to be unpacked before rows can be read in any order; None to read all rows once.
        threads: number that read the files which it names.
    """

    file: BinaryIO
    open_companion: OpenCompanion | None = None
    scratch: Scratch | None = None
    threads: int = 1


@dataclass(frozen=True, eq=False)
class Target:
    """Rows of a file to fill.

    Attributes:
        splats: n rows.
        start: number in the file of the first.
        tree: (n,) nodes to fill; None in a file without a tree.
        columns: of `Splats` to fill; a codec may fill the others, too.
    """

    splats: Splats
    start: int = 0
    tree: LodTree | None = None
    columns: Collection[str] = COLUMNS

    @property
    def stop(self) -> int:
        """Number in the file of the row after the last."""
        return self.start + len(self.splats)

    def rows(self, part: slice) -> Splats:
        """Return views of rows, which are counted as those of the file."""
        return self.splats.rows(slice(part.start - self.start, part.stop - self.start))

    def nodes(self, part: slice) -> LodTree | None:
        """Return views of nodes, counted as `rows`."""
        return None if self.tree is None else self.tree.rows(slice(part.start - self.start, part.stop - self.start))


class Fill(Protocol):
    """Reads and decodes rows; raises `FormatError` if the file is cut short or corrupt."""

    def __call__(self, target: Target, threads: int, progress: Progress) -> None: ...


@dataclass(frozen=True, eq=False)
class Content:
    """File whose header has been read.

    Attributes:
        count: N splats.
        sh_degree: of the decoded splats.
        format, antialiased, notes, up, up_by, chunk_bytes: as in `Scene`.
        fill: reads and decodes the splats.
        header: as in `Scene`; reading all splats may add to it.
        coding: called when all splats have been read, returns `Scene.coding`.
        has_tree: whether the splats are the nodes of a tree.
        block: splats that are read together at least; a stream reads whole ones.
    """

    count: int
    sh_degree: int
    format: str
    fill: Fill
    antialiased: bool = False
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None
    has_tree: bool = False
    chunk_bytes: tuple[int, ...] | None = None
    coding: Callable[[], FileCoding] = lambda: PLAIN
    block: int = 1
    up_by: str = ""

    def scene(
        self,
        *,
        columns: Collection[str] = COLUMNS,
        threads: int = 1,
        progress: Progress = silent,
        validate: bool = True,
    ) -> Scene:
        """Read all splats.

        Args:
            columns: of `Splats` to read; the others may be 0.
            validate: refuse a broken tree.

        Raises:
            FormatError: the file is cut short or corrupt, or its tree is broken.
        """
        make, tree = (Splats.empty if set(COLUMNS) <= set(columns) else Splats.zeros), None
        if self.has_tree:
            tree = LodTree(np.empty(self.count, np.uint16), np.empty(self.count, np.uint32))
        splats = make(self.count, self.sh_degree)
        self.fill(Target(splats, 0, tree, columns), threads, progress)
        scene = Scene(splats, tree, chunk_bytes=self.chunk_bytes, coding=self.coding(), **facts_of(self))
        return with_valid_tree(scene) if validate else scene

    def stream(self, threads: int) -> streams.SceneStream:
        """Return the splats block by block, each filled by several threads.

        Raises:
            HasTreeError: the file has a tree.
        """
        if self.has_tree:
            raise HasTreeError("it is a Level-of-Detail file already; give the splats that it was built from")

        def block(start: int, stop: int) -> Splats:
            out = Splats.empty(stop - start, self.sh_degree)
            self.fill(Target(out, start), threads, silent)
            return out

        def read(start: int, stop: int) -> Iterator[Splats]:
            step = self.block * max(1, streams.BLOCK_SPLATS // self.block)
            for first in range(start - start % self.block, stop, step):
                yield block(max(first, start), min(first + step, stop))

        if not self.count:  # there is nothing to read, but the data may be corrupt
            block(0, 0)
        return streams.SceneStream(self.count, self.sh_degree, read, **facts_of(self) | {"header": dict(self.header)})


def decode_file(
    codec: Any,
    file: BinaryIO,
    *,
    open_companion: OpenCompanion | None = None,
    threads: int = 1,
    progress: Progress = silent,
    **more: Any,
) -> Scene:
    """Read a whole scene from an open file by the module of its format; `more` is passed on to `Content.scene`."""
    content: Content = codec.open_content(Source(file, open_companion, threads=threads))
    return content.scene(threads=threads, progress=progress, **more)
