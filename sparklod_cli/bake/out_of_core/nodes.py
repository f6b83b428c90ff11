"""Nodes of a tree in their final order, gathered from the results of the stages, and rows that these hold splats as."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ...codecs.encoder import windows_of
from ...codecs.validation import check_valid
from ...model.lod_tree import LodTree
from ...model.sh import degree_of, width_of
from ...model.splats import COLUMNS, Splats
from ...model.streams import NodeStream
from ...system.progress import Progress
from ...system.threads import for_blocks, ordered_map
from .job import ROOT, Job, encoded_of, families_of, window_of
from .order import WINDOW_NODES
from .store import Store

#: (N, `width_of`) float32: centre, scale, rotation, opacity, rgb and SH of a splat, in the order of `COLUMNS`.
Rows = NDArray[np.float32]


def rows_of(splats: Splats, threads: int = 1) -> Rows:
    """Return the rows of splats."""
    rows = np.empty((len(splats), width_of(splats.sh_degree)), np.float32)
    fill_rows(splats, rows, threads)
    return rows


def fill_rows(splats: Splats, rows: Rows, threads: int = 1) -> None:
    """Fill rows with splats."""
    places = _places(splats)

    def fill(block: slice) -> None:
        for part, column in places:
            rows[block, part] = column[block]

    for_blocks(fill, len(rows), threads)


def splats_of(rows: Rows, threads: int = 1) -> Splats:
    """Return the splats of rows."""
    splats = Splats.empty(len(rows), degree_of((rows.shape[1] - width_of(0)) // 3))
    places = _places(splats)

    def fill(block: slice) -> None:
        for part, column in places:
            column[block] = rows[block, part]

    for_blocks(fill, len(rows), threads)
    return splats


def _places(splats: Splats) -> list[tuple[slice, Rows]]:
    """Return each column as a matrix, a view of it, and where it is in a row."""
    places, at = [], 0
    for name in COLUMNS:
        column = getattr(splats, name)
        numbers = math.prod(column.shape[1:])
        places.append((slice(at, at + numbers), column.reshape(len(splats), numbers)))
        at += numbers
    return places


def node_stream(job: Job, count: int) -> NodeStream:
    """Return the nodes of a tree that is in order."""
    read = functools.partial(_read, job.store, width_of(job.sh_degree))
    up = job.settings.up_of(job.stream.up)
    return NodeStream(count, job.sh_degree, job.stream.antialiased, read, up)


def encode(job: Job, window: int, *, threads: int, progress: Progress) -> None:
    """Encode a window; a task. Result: what the encoder of the output makes of its chunks, by their numbers."""
    assert job.encoder is not None
    encoder = job.encoder
    start = window * WINDOW_NODES
    stop = min(start + WINDOW_NODES, encoder.count)
    splats, tree = _read(job.store, width_of(job.sh_degree), start, stop, threads)
    check_valid(splats, threads)

    def encoded(part: slice) -> dict[str, NDArray[np.generic]]:
        return encoder.encode(splats.rows(part), tree.rows(part), start + part.start)

    arrays: dict[str, NDArray[np.generic]] = {}
    for number, found in enumerate(ordered_map(encoded, windows_of(stop - start), threads)):
        arrays |= {f"{number}.{name}": array for name, array in found.items()}
    job.store.put(encoded_of(window), arrays)


def encoded_chunk(store: Store, number: int, name: str) -> NDArray[np.generic]:
    """Return what `encode` made of a chunk: the array of this name."""
    window, place = divmod(number, len(windows_of(WINDOW_NODES)))
    key = f"{place}.{name}"
    return store.get(encoded_of(window), [key])[key]


def _read(store: Store, width: int, start: int, stop: int, threads: int = 1) -> tuple[Splats, LodTree]:
    """As `NodeStream.read`, of nodes whose rows have this width."""
    parts = []
    for window in range(start // WINDOW_NODES, -(-stop // WINDOW_NODES)):
        first = window * WINDOW_NODES
        rows, tree = _read_window(store, width, window)
        here = slice(max(start - first, 0), stop - first)
        parts.append((rows[here], tree.child_count[here], tree.child_start[here]))
    rows, count, child_start = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    return splats_of(rows, threads), LodTree(count.copy(), child_start.copy())


def _read_window(store: Store, width: int, window: int) -> tuple[Rows, LodTree]:
    """Return the nodes of a window, see `order.put_order`."""
    plan = store.get(window_of(window))
    count = plan["count"].astype(np.int64)
    total = int(count.sum()) + (window == 0)
    rows: Rows = np.empty((total, width), np.float32)
    if window == 0:
        rows[0] = store.get(ROOT, ["rows"])["rows"][0]
    row, target = (plan[name].astype(np.int64) for name in ("row", "target"))
    ends = plan["stages"]
    for stage in np.flatnonzero(np.diff(ends)).tolist():
        here = slice(ends[stage], ends[stage + 1])
        _fill(store, families_of(stage), row[here], count[here], target[here], rows)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    tree.child_count[plan["owner"]] = plan["child_count"]
    tree.child_start[plan["owner"]] = plan["child_start"]
    return rows, tree


def _fill(
    store: Store, name: str, row: NDArray[np.int64], count: NDArray[np.int64], target: NDArray[np.int64], rows: Rows
) -> None:
    """Fill rows with the children of some families of a stage: of each `count` of them, from `row` on, at `target`."""
    total = int(count.sum())
    step = np.arange(total) - np.repeat(np.cumsum(count) - count, count)
    rows[np.repeat(target, count) + step] = store.rows_at(name, "rows", np.repeat(row, count) + step)
