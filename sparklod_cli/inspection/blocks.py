"""Blocks of splats, from which reports are computed one by one, and the table of chunks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..codecs.rad.rad_reader import RadReader
from ..io.files import reopened
from ..lod.kernels.tree_links import find_depths, find_parents
from ..model.gaussian import spark_size
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import Scene
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import ordered_map
from ..tables.columns import Cell, Column, Row


def largest(rows: FloatArray) -> FloatArray:
    """Return the (n,) maximum of each of (n, 3) rows, as `rows.max(axis=1)` does, but thirty times as fast."""
    maximum: FloatArray = np.maximum(np.maximum(rows[:, 0], rows[:, 1]), rows[:, 2])
    return maximum


def smallest(rows: FloatArray) -> FloatArray:
    """Return the (n,) minimum of each of (n, 3) rows."""
    minimum: FloatArray = np.minimum(np.minimum(rows[:, 0], rows[:, 1]), rows[:, 2])
    return minimum


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive splats from index `start` on, and their nodes, whose children are numbered as in the whole tree."""

    start: int
    splats: Splats
    tree: LodTree | None

    @property
    def part(self) -> slice:
        """Range of its indices among all splats."""
        return slice(self.start, self.start + len(self.splats))


@dataclass(frozen=True, eq=False)
class ReportBlocks:
    """A scene, block by block.

    Attributes:
        about: scene with the metadata of the file, and with the splats and the tree if they are in memory.
        map: calls a function with each block, which has at least the given columns of `Splats`, and yields the results
            in order. Blocks in memory are processed on the given number of threads.
        in_memory: whether several threads may call `map`.
    """

    about: Scene
    count: int
    is_tree: bool
    map: Callable[[Callable[[Block], Any], Collection[str], int], Iterator[Any]]
    in_memory: bool = True

    @classmethod
    def of(cls, scene: Scene, unread: Collection[str] = ()) -> ReportBlocks:
        """Divide a scene in memory into blocks of the chunk size of its file, or of `CHUNK_NODES`.

        Columns in `unread` were not read; valid values replace them.
        """
        step, tree = scene.header.get("chunk_size") or CHUNK_NODES, scene.tree
        blank = Splats.zeros(step if unread else 0, 0)
        blank.quat_xyzw[:, 3] = 1

        def at(start: int) -> Block:
            part = slice(start, start + step)
            splats = scene.splats.take(part)
            replaced = {name: getattr(blank, name)[: len(splats)] for name in unread}
            return Block(start, dataclasses.replace(splats, **replaced), None if tree is None else tree.rows(part))

        def mapped(work: Callable[[Block], Any], columns: Collection[str], threads: int) -> Iterator[Any]:
            return ordered_map(lambda start: work(at(start)), range(0, len(scene.splats), step), threads)

        return cls(scene, len(scene.splats), tree is not None, mapped)

    @classmethod
    def of_file(cls, path: Path, rad: RadReader, *, threads: int = 1, progress: Progress = silent) -> ReportBlocks:
        """Read a file chunk by chunk in each `map`. The first one unpacks all columns, to find damage."""
        header, again = rad.header, False

        def mapped(work: Callable[[Block], Any], columns: Collection[str], _: int) -> Iterator[Any]:
            nonlocal again
            thorough, again = not again, True
            with reopened(path, rad) as reader:
                for start, splats, tree in reader.chunks(columns, thorough=thorough, threads=threads):
                    yield work(Block(start, splats, tree))
                    progress("reading", start + len(splats), header.count, "splat")

        return cls(rad.about(), header.count, header.lod_tree, mapped, in_memory=False)


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

#: Columns of the printed table, with their headings and widths, 80 characters in all.
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
    """Return the row of a block with center, scale and opacity, for `chunk_table` to complete."""
    center, size = block.splats.center, spark_size(block.splats)
    low, high = center.min(axis=0), center.max(axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        extent = np.linalg.norm(high.astype(np.float64) - low)
    numbers = dict(zip(("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"), (*low, *high), strict=True))
    numbers |= {"extent": extent, "size_min": size.min(), "size_max": size.max()}
    row: dict[str, Any] = dict.fromkeys(column.name for column in CHUNK_COLUMNS)
    row |= {"base": block.start, "splats": len(center)}
    row["leaves"] = None if block.tree is None else int(np.count_nonzero(block.tree.is_leaf))
    return row | {name: float(value) for name, value in numbers.items() if np.isfinite(value)}


def chunk_table(
    rows: Sequence[dict[str, Any]], chunk_bytes: Sequence[int] | None, nodes: tuple[LodTree, FloatArray] | None
) -> list[Row]:
    """Complete the rows of all chunks, see `chunk_row`.

    Args:
        chunk_bytes: sizes in the file; None for formats without chunks.
        nodes: the tree and its (N,) feature sizes.
    """
    if nodes is not None:
        tree, size = nodes
        depth, _ = find_depths(tree.child_count, tree.child_start, size)
        parent, _ = find_parents(tree.child_count, tree.child_start)
    for chunk, row in enumerate(rows):
        row["chunk"], row["bytes"] = chunk, None if chunk_bytes is None else chunk_bytes[chunk]
        if nodes is not None:
            part = slice(row["base"], row["base"] + row["splats"])
            chunks = np.unique(parent[part][parent[part] >= 0] // rows[0]["splats"])
            row["parent_chunks"] = int(np.count_nonzero(chunks != chunk))
            row["depth_min"], row["depth_max"] = (int(max(end, 0)) for end in (depth[part].min(), depth[part].max()))
    return [{column.name: column.rounded(row[column.name]) for column in CHUNK_COLUMNS} for row in rows]


def chunk_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the printed table, without empty columns."""
    shown = {name: column for name, column in SHOWN_COLUMNS.items() if any(row[name] is not None for row in rows)}
    yield "".join(f"{heading:>{width}}" for heading, width in shown.values())
    for row in rows:
        yield "".join(f"{_text(row[name]):>{width}}" for name, (_, width) in shown.items())


def _text(value: Cell) -> str:
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value
