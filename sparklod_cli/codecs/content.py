"""What is in a file without a tree: one function fills the columns of a whole scene, or those of a stream's blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO, Protocol

from ..model import streams
from ..model.scene import Scene
from ..model.splats import COLUMNS, Splats
from ..support.progress import Progress, silent

#: Opens a file of these bytes, which are made only if they have not been before; for formats whose splats do not lie
#: one after the other. Whoever gives it closes the file.
Scratch = Callable[[Callable[[], Iterable[bytes]]], BinaryIO]


#: What is said of a file with a tree, which has no stream.
HAS_TREE = "it is a Level-of-Detail file already; give the splats that it was built from"


class Fill(Protocol):
    """Fills the columns of `out` with the splats of a file from `start` on.

    Raises:
        FormatError: the file is cut short or corrupt.
    """

    def __call__(self, out: Splats, start: int, threads: int, progress: Progress) -> None: ...


@dataclass(frozen=True, eq=False)
class Content:
    """A file whose header has been read, and what reads the rest of it.

    Attributes:
        count: N splats.
        sh_degree: as they are read.
        fill: reads and decodes them.
        format, antialiased, notes, header, up: as in `Scene`.
    """

    count: int
    sh_degree: int
    fill: Fill
    format: str
    antialiased: bool = False
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None

    def scene(self, threads: int, progress: Progress) -> Scene:
        """All splats."""
        splats = Splats.empty(self.count, self.sh_degree)
        self.fill(splats, 0, threads, progress)
        return Scene(splats, None, self.antialiased, self.format, self.notes, self.header, up=self.up)

    def stream(self, threads: int) -> streams.SceneStream:
        """The splats block by block, each filled by several threads."""

        def block(start: int, stop: int) -> Splats:
            out = Splats.empty(stop - start, self.sh_degree)
            self.fill(out, start, threads, silent)
            return out

        def read(start: int, stop: int) -> Iterator[Splats]:
            for first in range(start, stop, streams.BLOCK_SPLATS):
                yield block(first, min(first + streams.BLOCK_SPLATS, stop))

        about = self.antialiased, self.format, self.notes, self.header, self.up
        return streams.SceneStream(self.count, self.sh_degree, read, *about)


def rows_in(splats: Splats, part: slice, start: int = 0) -> Splats:
    """Views of rows, to be filled.

    Args:
        splats: the columns.
        part: which rows, counted as those of the file.
        start: number of the first row of the columns in the file.
    """
    views = slice(part.start - start, part.stop - start)
    return Splats(**{name: getattr(splats, name)[views] for name in COLUMNS})
