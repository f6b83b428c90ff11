"""Blocks of splats that a report reads one by one, tallies of faults in them, and the table of chunks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..codecs.rad.rad_reader import RadReader
from ..io.files import reopened
from ..lod.kernels.tree_links import find_depths, find_parents
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..tables.columns import Cell, Column, Row
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
    """Consecutive splats from index `start` on, and their nodes, whose children are numbered as in the whole tree."""

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
        """(n,) bool, true for splats in no mask of `invalid`."""
        return ~np.logical_or.reduce([*self.invalid.values(), np.zeros(len(self.splats), np.bool_)])


@dataclass(frozen=True, eq=False)
class ReportBlocks:
    """A scene, block by block.

    Attributes:
        about: scene with the header of the file, and with the splats and the tree if they are in memory.
        map: called with a function of a block, columns of `Splats` and a number of threads, returns the results in
            order; may be called again. Blocks in memory have all columns and are processed on these threads.
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

        Columns in `unread` were not read and count as valid.
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
    def of_file(cls, path: Path, rad: RadReader, *, threads: int = 1, progress: Progress = silent) -> ReportBlocks:
        """Chunks of a file, which is opened each time. The first time, all columns are unpacked, to find damage."""
        header, again = rad.header, False

        def mapped(work: Callable[[Block], Any], columns: Collection[str], _: int) -> Iterator[Any]:
            nonlocal again
            thorough, again = not again, True
            with reopened(path, rad) as reader:
                for start, splats, tree in reader.chunks(columns, thorough=thorough, threads=threads):
                    yield work(Block(start, splats, tree))
                    progress("reading", start + len(splats), header.count, "splat")

        return cls(rad.about(), header.count, header.lod_tree, mapped, in_memory=False)


@dataclass(frozen=True)
class MaskTally:
    """Number of splats or nodes in a mask, and the index of the first."""

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
        """Return a finding if there are any; in its text, {first} is the first and {more} the number of the rest."""
        if not self.count:
            return []
        message = text.format(first=f"{self.first:,}", more=f"{self.count - 1:,}")
        return [Finding(code, message, self.first, self.count)]


def tallies(masks: dict[str, Mask], start: int) -> dict[str, MaskTally]:
    """Tallies of the masks of a block that begins at `start`, by their names."""
    return {name: MaskTally.of(mask, start) for name, mask in masks.items()}


def merged(parts: Iterable[dict[str, MaskTally]]) -> dict[str, MaskTally]:
    """Tallies of all blocks, in order."""
    total: dict[str, MaskTally] = {}
    for part in parts:
        for name, tally in part.items():
            total[name] = total.get(name, MaskTally()) + tally
    return total


CHUNK_COLUMNS = (
    Column("chunk", int, "", "", "number of the chunk, from 0"),
    Column("base", int, "", "", "index of its first splat"),
    Column("splats", int, "", "splats", "splats; nodes in a tree"),
    Column("leaves", int, "", "splats", "leaves among them; empty without a tree"),
    Column("bytes", int, "", "bytes", "size in the file; empty in formats without chunks"),
    *(
        Column(f"{end}_{axis}", float, ".6g", "world units", f"{what} {axis} of the centres")
        for end, what in (("min", "lowest"), ("max", "highest"))
        for axis in "xyz"
    ),
    Column("extent", float, ".6g", "world units", "diagonal of the box of the centres"),
    Column("size_min", float, ".6g", "world units", "smallest feature size"),
    Column("size_max", float, ".6g", "world units", "largest feature size"),
    Column("depth_min", int, "", "", "smallest depth of a node; empty without a tree"),
    Column("depth_max", int, "", "", "largest depth of a node; empty without a tree"),
    Column("parent_chunks", int, "", "", "other chunks that hold parents of its nodes; empty without a tree"),
)

#: The columns of a table that a person reads, with their headings and widths, 80 in all.
SHOWN_COLUMNS = {
    "chunk": ("chunk", 6),
    "splats": ("splats", 8),
    "leaves": ("leaves", 8),
    "bytes": ("bytes", 11),
    "extent": ("extent", 9),
    "size_min": ("size", 10),
    "size_max": ("to", 10),
    "depth_min": ("depth", 6),
    "depth_max": ("to", 4),
    "parent_chunks": ("parents", 8),
}


def chunk_row(block: Block) -> dict[str, Any]:
    """Return the row of a chunk with center, scale and opacity, without its number and its bytes."""
    center, size = block.splats.center, spark_size(block.splats)
    low, high = center.min(axis=0), center.max(axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        extent = np.linalg.norm(high.astype(np.float64) - low)
    numbers = {"extent": extent, "size_min": size.min(), "size_max": size.max()}
    numbers |= {f"min_{axis}": low[at] for at, axis in enumerate("xyz")}
    numbers |= {f"max_{axis}": high[at] for at, axis in enumerate("xyz")}
    row: dict[str, Any] = dict.fromkeys(column.name for column in CHUNK_COLUMNS)
    row |= {"base": block.start, "splats": len(center)}
    row["leaves"] = None if block.tree is None else int(np.count_nonzero(block.tree.is_leaf))
    return row | {name: float(value) for name, value in numbers.items() if np.isfinite(value)}


def chunk_table(
    rows: Sequence[dict[str, Any]], chunk_bytes: Sequence[int] | None, nodes: tuple[LodTree, FloatArray] | None
) -> list[Row]:
    """Return the rows with a cell for each of `CHUNK_COLUMNS`.

    Args:
        rows: of all chunks in order, see `chunk_row`.
        chunk_bytes: of the chunks in the file; None where its format has no chunks.
        nodes: the tree and its (N,) feature sizes.
    """
    for chunk, row in enumerate(rows):
        row["chunk"], row["bytes"] = chunk, None if chunk_bytes is None else chunk_bytes[chunk]
    if nodes is not None:
        _add_links(rows, *nodes)
    return [{column.name: column.rounded(row[column.name]) for column in CHUNK_COLUMNS} for row in rows]


def _add_links(rows: Sequence[dict[str, Any]], tree: LodTree, size: FloatArray) -> None:
    depth, _ = find_depths(tree.child_count, tree.child_start, size)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    step = rows[0]["splats"]
    for number, row in enumerate(rows):
        part = slice(row["base"], row["base"] + row["splats"])
        above = parent[part]
        elsewhere = np.unique(above[above >= 0] // step)
        row["parent_chunks"] = int(np.count_nonzero(elsewhere != number))
        row["depth_min"], row["depth_max"] = (int(max(end, 0)) for end in (depth[part].min(), depth[part].max()))


def chunk_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of a readable table; its rows may come from JSON."""
    shown = {name: column for name, column in SHOWN_COLUMNS.items() if any(row[name] is not None for row in rows)}
    yield "".join(f"{heading:>{width}}" for heading, width in shown.values())
    for row in rows:
        yield "".join(f"{_text(row[name]):>{width}}" for name, (_, width) in shown.items())


def _text(value: Cell) -> str:
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value
