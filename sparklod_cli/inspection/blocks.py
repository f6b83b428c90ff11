"""Splats as a report reads them, block by block and as often as it takes, and tallies of what some of them have."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..io.rad_file import RadFile
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from .findings import Finding

Mask = NDArray[np.bool_]


def largest(rows: FloatArray) -> FloatArray:
    """(n,) the largest number of each of (n, 3) rows, NaN if one is; ten times as fast as `rows.max(axis=1)`."""
    x, y, z = rows.T
    numbers: FloatArray = np.maximum(np.maximum(x, y), z)
    return numbers


def smallest(rows: FloatArray) -> FloatArray:
    """(n,) the smallest, as `largest`."""
    x, y, z = rows.T
    numbers: FloatArray = np.minimum(np.minimum(x, y), z)
    return numbers


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive splats.

    Attributes:
        start: index of the first.
        splats: n of them.
        tree: (n,) nodes with children as the whole tree numbers them; None without a tree.
    """

    start: int
    splats: Splats
    tree: LodTree | None

    @property
    def part(self) -> slice:
        """Place among all splats."""
        return slice(self.start, self.start + len(self.splats))

    @functools.cached_property
    def invalid(self) -> dict[str, Mask]:
        """As `Splats.invalid`."""
        return self.splats.invalid()

    @functools.cached_property
    def valid(self) -> Mask:
        """(n,) bool, true for splats that are in no mask of `invalid`."""
        return ~np.logical_or.reduce([*self.invalid.values(), np.zeros(len(self.splats), np.bool_)])


@dataclass(frozen=True, eq=False)
class ReportBlocks:
    """A scene, block by block.

    Attributes:
        about: scene with the header of the file, and with the splats and the tree if they are in memory.
        count: N splats.
        is_tree: whether they are the nodes of a tree.
        map: called with a function of a block, columns of `Splats` and a number of threads, returns the results in
            order; may be called again. Blocks in memory have all columns and are processed on that many threads.
        in_memory: whether several threads may call `map`.
    """

    about: Scene
    count: int
    is_tree: bool
    map: Callable[[Callable[[Block], Any], Collection[str], int], Iterator[Any]]
    in_memory: bool = True

    @classmethod
    def of(cls, scene: Scene, unread: Collection[str] = ()) -> ReportBlocks:
        """Blocks of an in-memory scene, as long as the chunks of its file, or `CHUNK_NODES`.

        Args:
            unread: columns that were not read and count as valid.
        """
        step, tree = scene.header.get("chunk_size") or CHUNK_NODES, scene.tree
        blank = Splats.zeros(step if unread else 0, 0)
        blank.quat_xyzw[:, 3] = 1

        def at(start: int) -> Block:
            part = slice(start, start + step)
            count = len(scene.splats.center[part])
            rows = {
                name: getattr(blank, name)[:count] if name in unread else getattr(scene.splats, name)[part]
                for name in COLUMNS
            }
            nodes = None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])
            return Block(start, Splats(**rows), nodes)

        def mapped(work: Callable[[Block], Any], columns: Collection[str], threads: int) -> Iterator[Any]:
            return ordered_map(lambda start: work(at(start)), range(0, len(scene.splats), step), threads)

        return cls(scene, len(scene.splats), tree is not None, mapped)

    @classmethod
    def of_file(cls, file: RadFile, *, threads: int = 1, progress: Progress = silent) -> ReportBlocks:
        """Chunks of a file. The first time they are read, all of their columns are unpacked, to find damage."""
        header, again = file.header, False

        def mapped(work: Callable[[Block], Any], columns: Collection[str], _: int) -> Iterator[Any]:
            nonlocal again
            thorough, again = not again, True
            for start, splats, tree in file.chunks(columns, thorough=thorough, threads=threads):
                yield work(Block(start, splats, tree))
                progress("reading", start + len(splats), header.count, "splat")

        return cls(file.scene, header.count, header.lod_tree, mapped, in_memory=False)


@dataclass(frozen=True)
class MaskTally:
    """Number of splats or nodes that have something, and the index of the first."""

    count: int = 0
    first: int = -1

    @classmethod
    def of(cls, mask: Mask, start: int) -> MaskTally:
        """Tally of a block that begins at `start`."""
        count = int(np.count_nonzero(mask))
        return cls(count, start + int(np.argmax(mask))) if count else cls()

    def __add__(self, following: MaskTally) -> MaskTally:
        """Tally of two parts, in order."""
        return MaskTally(self.count + following.count, self.first if self.count else following.first)

    def finding(self, code: str, text: str) -> list[Finding]:
        """Return a finding if there are any; in its text, {first} is the first and {more} how many others."""
        if not self.count:
            return []
        message = text.format(first=f"{self.first:,}", more=f"{self.count - 1:,}")
        return [Finding(code, message, self.first, self.count)]


def tallies(masks: dict[str, Mask], start: int) -> dict[str, MaskTally]:
    """Tallies of the masks of a block that begins at `start`, by their names."""
    return {name: MaskTally.of(mask, start) for name, mask in masks.items()}


def merged(parts: Iterable[dict[str, MaskTally]]) -> dict[str, MaskTally]:
    """Tallies of all blocks, in order; a name that a block lacks counts as none there."""
    total: dict[str, MaskTally] = {}
    for part in parts:
        for name, tally in part.items():
            total[name] = total.get(name, MaskTally()) + tally
    return total
