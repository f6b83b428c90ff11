"""The chunks of a file, one by one: how much of a scene each covers tells how well its nodes are ordered."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.tree_links import find_depths, find_parents
from ..model.gaussian import spark_size
from ..model.nodes import CHUNK_NODES
from ..model.scene import Scene
from ..tables.columns import Cell, Column, Row

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

#: The columns of a table that a person reads, and their widths.
SHOWN = {
    "chunk": 6,
    "base": 12,
    "splats": 8,
    "leaves": 8,
    "bytes": 11,
    "extent": 10,
    "size_min": 11,
    "size_max": 11,
    "depth_min": 10,
    "depth_max": 10,
    "parent_chunks": 14,
}


def rows_of(scene: Scene) -> list[Row]:
    """A row for each chunk, with a cell for each of `COLUMNS`.

    Args:
        scene: whose chunks are those of its file, or of `CHUNK_NODES` splats where its format has none.
    """
    count = len(scene.splats)
    step = scene.header.get("chunk_size") or CHUNK_NODES
    if not count:
        return []
    starts = np.arange(0, count, step)
    center, size = scene.splats.center, spark_size(scene.splats)
    low, high = np.minimum.reduceat(center, starts), np.maximum.reduceat(center, starts)
    with np.errstate(invalid="ignore", over="ignore"):
        extent = np.linalg.norm(high.astype(np.float64) - low, axis=1)
    numbers = {"extent": extent}
    numbers |= {f"min_{axis}": low[:, at] for at, axis in enumerate("xyz")}
    numbers |= {f"max_{axis}": high[:, at] for at, axis in enumerate("xyz")}
    numbers |= {"size_min": np.minimum.reduceat(size, starts), "size_max": np.maximum.reduceat(size, starts)}
    links = _links(scene, starts, step, size)
    sizes = scene.chunk_bytes
    rows = []
    for chunk, base in enumerate(starts.tolist()):
        row: dict[str, Any] = dict.fromkeys(column.name for column in COLUMNS)
        row |= {"chunk": chunk, "base": base, "splats": min(step, count - base)}
        row["bytes"] = None if sizes is None else sizes[chunk]
        row |= {name: int(values[chunk]) for name, values in links.items()}
        row |= {name: float(values[chunk]) for name, values in numbers.items() if np.isfinite(values[chunk])}
        rows.append({column.name: column.rounded(row[column.name]) for column in COLUMNS})
    return rows


def _links(scene: Scene, starts: NDArray[np.intp], step: int, size: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """What each chunk has of the tree; nothing without one."""
    tree = scene.tree
    if tree is None:
        return {}
    depth, _ = find_depths(tree.child_count, tree.child_start, size)
    parent, _ = find_parents(tree.child_count, tree.child_start)
    child = np.flatnonzero(parent >= 0)
    pairs = np.unique((child // step) * len(starts) + parent[child] // step)
    elsewhere = pairs[pairs // len(starts) != pairs % len(starts)]
    return {
        "leaves": np.add.reduceat(tree.is_leaf.astype(np.int64), starts),
        "depth_min": np.minimum.reduceat(np.maximum(depth, 0), starts),
        "depth_max": np.maximum.reduceat(depth, starts).clip(0),
        "parent_chunks": np.bincount(elsewhere // len(starts), minlength=len(starts)),
    }


def lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The table as a person reads it; its rows may come from JSON."""
    shown = {name: width for name, width in SHOWN.items() if any(row[name] is not None for row in rows)}
    yield "".join(f"{name:>{width}}" for name, width in shown.items())
    for row in rows:
        yield "".join(f"{_text(row[name]):>{width}}" for name, width in shown.items())


def _text(value: Cell) -> str:
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else value
