"""Scenes and trees that pass through memory piece by piece, because they may be larger than it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from ..support.progress import Progress, silent
from .lod_tree import LodTree
from .scene import Scene
from .splats import COLUMNS, Splats

#: Splats of a block that a scene is read in, unless its format has other ones: some 30 MB with SH of degree 3.
BLOCK_SPLATS = 1 << 17


@dataclass(frozen=True, eq=False)
class SceneStream:
    """The splats of one or several files, read in blocks whenever they are asked for.

    Attributes:
        count: N splats, as the files promise.
        sh_degree: of all blocks.
        antialiased, format, notes, header, up: as in `Scene`.
        read: called with the range of splats that are wanted, gives them in order in blocks of any length; may be
            called again. Formats that cannot be entered in the middle read and skip what comes before.
    """

    count: int
    sh_degree: int
    read: Callable[[int, int], Iterator[Splats]]
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    up: str | None = None

    def blocks(self) -> Iterator[Splats]:
        """All splats, in order."""
        return self.read(0, self.count)


@dataclass(frozen=True, eq=False)
class NodeStream:
    """The nodes of a tree in their final order, made whenever they are asked for.

    Attributes:
        count: M nodes.
        leaves: how many of them are leaves.
        sh_degree: of all windows.
        antialiased, up: as in `Scene`.
        read: called with a range of nodes, returns them and their tree columns, whose `child_start` counts from the
            first node of the whole tree; may be called again, from several threads at once.
    """

    count: int
    leaves: int
    sh_degree: int
    antialiased: bool
    read: Callable[[int, int], tuple[Splats, LodTree]]
    up: str | None = None

    def windows(self, rows: int) -> Iterator[tuple[Splats, LodTree]]:
        """All nodes, in order, so many at a time."""
        for start in range(0, self.count, rows):
            yield self.read(start, min(start + rows, self.count))


def stream_of(scene: Scene) -> SceneStream:
    """A stream of a scene in memory, which has no tree."""
    assert scene.tree is None

    def read(start: int, stop: int) -> Iterator[Splats]:
        for first in range(start, stop, BLOCK_SPLATS):
            yield scene.splats.take(slice(first, min(first + BLOCK_SPLATS, stop)))

    splats, about = scene.splats, (scene.antialiased, scene.format, scene.notes, scene.header, scene.up)
    return SceneStream(len(splats), splats.sh_degree, read, *about)


def collected(stream: SceneStream, progress: Progress = silent) -> Scene:
    """All of a stream in memory, which takes no more of it than the scene and a block."""
    splats, done = Splats.empty(stream.count, stream.sh_degree), 0
    for block in stream.blocks():
        part = slice(done, done := done + len(block))
        for name in COLUMNS:
            getattr(splats, name)[part] = getattr(block, name)
        progress("reading", done, stream.count, "splat")
    return Scene(splats, None, stream.antialiased, stream.format, stream.notes, stream.header, up=stream.up)
