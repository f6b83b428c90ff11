"""`Blocks`: what a report reads, in memory or in a file, block by block and as often as it takes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..io import RadFile
from ..model.lod_tree import LodTree
from ..model.nodes import CHUNK_NODES
from ..model.scene import Scene
from ..model.splats import COLUMNS, Splats
from ..support.progress import Progress, silent
from .findings import Finding

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Block:
    """Some splats in a row.

    Attributes:
        start: index of the first.
        splats: n of them; columns that were not asked for may be 0.
        tree: (n,) of them where they are nodes of a tree, with children as the whole tree numbers them.
    """

    start: int
    splats: Splats
    tree: LodTree | None

    @functools.cached_property
    def invalid(self) -> dict[str, Mask]:
        """As `Splats.invalid`; all columns must be there."""
        return self.splats.invalid()

    @functools.cached_property
    def valid(self) -> Mask:
        """(n,) bool, true for splats that are in no mask of `invalid`."""
        valid = np.ones(len(self.splats), np.bool_)
        for mask in self.invalid.values():
            valid &= ~mask
        return valid


@dataclass(frozen=True, eq=False)
class Blocks:
    """A scene, block by block.

    Attributes:
        count: N splats.
        sh_degree: of the splats.
        is_tree: whether they are the nodes of a tree.
        read: called with columns of `Splats`, gives the blocks in order; may be called again.
        antialiased, format, notes, header, chunk_bytes: as in `Scene`.
    """

    count: int
    sh_degree: int
    is_tree: bool
    read: Callable[[Collection[str]], Iterator[Block]]
    antialiased: bool = False
    format: str = ""
    notes: tuple[str, ...] = ()
    header: Mapping[str, int] = field(default_factory=dict)
    chunk_bytes: tuple[int, ...] | None = None

    @classmethod
    def of(cls, scene: Scene) -> Blocks:
        """Those of a scene in memory, as long as its chunks are, or `CHUNK_NODES`."""
        count, step = len(scene.splats), scene.header.get("chunk_size") or CHUNK_NODES

        def read(columns: Collection[str]) -> Iterator[Block]:
            for start in range(0, count, step):
                part = slice(start, start + step)
                rows = Splats(**{name: getattr(scene.splats, name)[part] for name in COLUMNS})
                tree = scene.tree
                yield Block(
                    start, rows, None if tree is None else LodTree(tree.child_count[part], tree.child_start[part])
                )

        return cls(
            count,
            scene.splats.sh_degree,
            scene.tree is not None,
            read,
            scene.antialiased,
            scene.format,
            scene.notes,
            scene.header,
            scene.chunk_bytes,
        )

    @classmethod
    def of_file(cls, file: RadFile, *, threads: int = 1, progress: Progress = silent) -> Blocks:
        """The chunks of a file. The first time they are read, all of their columns are unpacked, to find damage."""
        header, again = file.header, False

        def read(columns: Collection[str]) -> Iterator[Block]:
            nonlocal again
            thorough, again = not again, True
            for start, splats, tree in file.chunks(columns, thorough=thorough, threads=threads):
                yield Block(start, splats, tree)
                progress("reading", start + len(splats), header.count, "splat")

        return cls(
            header.count,
            header.max_sh,
            header.lod_tree,
            read,
            header.antialiased,
            file.format,
            (),
            file.about,
            file.chunk_bytes,
        )


@dataclass
class Tally:
    """How many splats or nodes have something, and the first of them."""

    count: int = 0
    first: int = -1

    def add(self, mask: Mask, start: int) -> None:
        """Counts those of a block that begins at `start`."""
        count = int(np.count_nonzero(mask))
        if count and not self.count:
            self.first = start + int(np.argmax(mask))
        self.count += count

    def finding(self, code: str, text: str) -> list[Finding]:
        """A finding about them, if there are any; in its text, {first} is the first and {more} how many others."""
        if not self.count:
            return []
        more = f"{self.count - 1:,}"
        return [Finding(code, text.format(first=f"{self.first:,}", more=more), self.first, self.count)]
