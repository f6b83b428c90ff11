"""Scenes and trees that pass through memory piece by piece, because they may be larger than it."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..system.errors import SparklodError
from ..system.progress import Progress, silent
from ..system.units import count_of
from .axes import common, differing, rotated
from .lod_tree import LodTree
from .scene import Scene, facts_of
from .sh import COEFFICIENTS
from .splats import COLUMNS, Splats
from .transforms import Transform

#: Splats of a block that a scene is read in, unless its format has other ones: some 30 MB with SH of degree 3.
BLOCK_SPLATS = 1 << 17


@dataclass(frozen=True, eq=False)
class SceneStream:
    """The splats of one or several files, read in blocks whenever they are asked for.

    Attributes:
        count: N splats, as the files promise.
        sh_degree: of all blocks.
        antialiased, format, notes, header, up, up_by: as in `Scene`.
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
    up_by: str = ""

    def blocks(self) -> Iterator[Splats]:
        """Read all splats, in order."""
        return self.read(0, self.count)


@dataclass(frozen=True, eq=False)
class NodeStream:
    """The nodes of a tree in their final order, made whenever they are asked for.

    Attributes:
        count: M nodes.
        sh_degree: of all windows.
        antialiased, up: as in `Scene`.
        read: called with a range of nodes, returns them and their tree columns, whose `child_start` counts from the
            first node of the whole tree; may be called again, from several threads at once.
    """

    count: int
    sh_degree: int
    antialiased: bool
    read: Callable[[int, int], tuple[Splats, LodTree]]
    up: str | None = None


def collected(stream: SceneStream, progress: Progress = silent) -> Scene:
    """Read all of a stream into memory, which takes no more of it than the scene and a block."""
    splats, done = Splats.empty(stream.count, stream.sh_degree), 0
    for block in stream.blocks():
        part = slice(done, done := done + len(block))
        for name in COLUMNS:
            getattr(splats, name)[part] = getattr(block, name)
        progress("reading", done, stream.count, "splat")
    return Scene(splats, **facts_of(stream))


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene and where it stands.

    Attributes:
        stream: its splats.
        name: in messages.
        transform: turns, scales and moves them.
    """

    stream: SceneStream
    name: str
    transform: Transform = dataclasses.field(default_factory=Transform)


def merged(parts: Sequence[Placed]) -> SceneStream:
    """Merge scenes into one: their splats in this order, of the highest SH degree; lower ones are padded with zeros.

    It is antialiased if most of the splats are; notes tell where they differ. An axis points up that does in all of
    them. What is wrong with one of them is raised with its name.

    Args:
        parts: at least one.
    """
    firsts = tuple(itertools.accumulate((part.stream.count for part in parts), initial=0))
    degree = max(part.stream.sh_degree for part in parts)
    antialiased, notes = _antialiased(parts)
    notes += tuple(f"{part.name}: {note}" for part in parts for note in part.stream.notes)
    axes = [rotated(part.stream.up, part.transform.rotation) for part in parts]
    notes += tuple(f"{text}, so none is noted unless --up names it" for text in differing(axes))
    return SceneStream(
        firsts[-1],
        degree,
        _ReadMerged(tuple(parts), firsts, degree),
        antialiased,
        " and ".join(sorted({part.stream.format for part in parts})),
        tuple(dict.fromkeys(notes)),
        up=common(axes),
        up_by=(common(part.stream.up_by for part in parts) or "") if axes == [part.stream.up for part in parts] else "",
    )


def _antialiased(parts: Sequence[Placed]) -> tuple[bool, tuple[str, ...]]:
    """Return whether most splats are antialiased, and notes where they differ."""
    count = sum(part.stream.count for part in parts)
    found = sum(part.stream.count for part in parts if part.stream.antialiased)
    most = 2 * found > count
    if found in (0, count):
        return most, ()
    kind = "antialiased" if most else "not antialiased"
    text = f"{found:,} of {count_of(count, 'splat')} are antialiased, and the others are not; all are written as {kind}"
    return most, (text,)


@dataclass(frozen=True, eq=False)
class _ReadMerged:
    """`SceneStream.read` of several scenes; can be pickled if their streams can."""

    parts: tuple[Placed, ...]
    firsts: tuple[int, ...]
    sh_degree: int

    def __call__(self, start: int, stop: int) -> Iterator[Splats]:
        number = bisect.bisect_right(self.firsts, start) - 1
        while start < stop:
            part, first, last = self.parts[number], self.firsts[number], min(self.firsts[number + 1], stop)
            try:
                for splats in part.stream.read(start - first, last - first):
                    yield part.transform.apply(_padded(splats, self.sh_degree))
            except SparklodError as error:
                raise type(error)(f"{part.name}: {error}") from None
            start, number = last, number + 1


def _padded(splats: Splats, sh_degree: int) -> Splats:
    """Return splats of at least this SH degree; coefficients that they lack are 0."""
    if splats.sh_degree >= sh_degree:
        return splats
    sh = np.zeros((len(splats), COEFFICIENTS[sh_degree], 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh
    return dataclasses.replace(splats, sh=sh)
