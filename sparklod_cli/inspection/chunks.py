"""The chunks of a file, one by one: how much of a scene each covers tells how well its nodes are ordered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..lod.kernels.tree_links import find_depths, find_parents
from ..model.gaussian import spark_size
from ..tables.columns import Cell, Column, Row
from . import tree
from .blocks import Block

COLUMNS = (
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
SHOWN = {
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


def row_of(block: Block) -> dict[str, Any]:
    """Return the row of a chunk, a block with center, scale and opacity, without its number and its bytes."""
    center, size = block.splats.center, spark_size(block.splats)
    low, high = center.min(axis=0), center.max(axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        extent = np.linalg.norm(high.astype(np.float64) - low)
    numbers = {"extent": extent, "size_min": size.min(), "size_max": size.max()}
    numbers |= {f"min_{axis}": low[at] for at, axis in enumerate("xyz")}
    numbers |= {f"max_{axis}": high[at] for at, axis in enumerate("xyz")}
    row: dict[str, Any] = dict.fromkeys(column.name for column in COLUMNS)
    row |= {"base": block.start, "splats": len(center)}
    row["leaves"] = None if block.tree is None else int(np.count_nonzero(block.tree.is_leaf))
    return row | {name: float(value) for name, value in numbers.items() if np.isfinite(value)}


def table_of(
    rows: Sequence[dict[str, Any]], chunk_bytes: Sequence[int] | None, nodes: tree.TreeColumns | None
) -> list[Row]:
    """Return the rows with a cell for each of `COLUMNS`.

    Args:
        rows: of all chunks in order, see `row_of`.
        chunk_bytes: of the chunks in the file; None where its format has no chunks.
        nodes: of the tree; None without one.
    """
    for chunk, row in enumerate(rows):
        row["chunk"], row["bytes"] = chunk, None if chunk_bytes is None else chunk_bytes[chunk]
    if nodes is not None:
        _add_links(rows, nodes)
    return [{column.name: column.rounded(row[column.name]) for column in COLUMNS} for row in rows]


def _add_links(rows: Sequence[dict[str, Any]], nodes: tree.TreeColumns) -> None:
    links = nodes.tree
    depth, _ = find_depths(links.child_count, links.child_start, nodes.size)
    parent, _ = find_parents(links.child_count, links.child_start)
    step = rows[0]["splats"]
    for number, row in enumerate(rows):
        part = slice(row["base"], row["base"] + row["splats"])
        above = parent[part]
        elsewhere = np.unique(above[above >= 0] // step)
        row["parent_chunks"] = int(np.count_nonzero(elsewhere != number))
        row["depth_min"], row["depth_max"] = (int(max(end, 0)) for end in (depth[part].min(), depth[part].max()))


def lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the table as a person reads it; its rows may come from JSON."""
    shown = {name: column for name, column in SHOWN.items() if any(row[name] is not None for row in rows)}
    yield "".join(f"{heading:>{width}}" for heading, width in shown.values())
    for row in rows:
        yield "".join(f"{_text(row[name]):>{width}}" for name, (_, width) in shown.items())


def _text(value: Cell) -> str:
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value
