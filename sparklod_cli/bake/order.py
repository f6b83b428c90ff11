"""Order of the nodes of a tree out of core, and windows of nodes gathered from the results of the stages."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..codecs.encoder import windows_of
from ..codecs.reader import Reader, RowBuffer
from ..lod.chunk_order import MOST_FAMILIES, band_order, family_order
from ..lod.kernels.tree_links import find_limits
from ..lod.stages import NO_FAMILY, STAGE_BITS
from ..lod.tree_settings import BUILDERS
from ..model.lod_tree import CHUNK_NODES, LodTree
from ..model.scene import rotated_axis
from ..model.sh import degree_of, width_of
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress
from ..system.threads import blocks_of, for_blocks, on_threads, ordered_map
from .job import ORDER, ROOT, Job, encoded_of, families_of, window_of
from .store import Store

#: Nodes of a window, whole chunks: 30 MB without SH, 120 MB with SH of degree 3. Chosen.
WINDOW_NODES = 8 * CHUNK_NODES

#: Families whose keys are in memory at once, some 100 MB, and sampled keys that balance as many families. Chosen.
MERGED, PROBES = 1 << 22, 256

#: Range of the families of a stage: stage, first family, end.
Run = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class _Links:
    """Links between F families (the children of a node), numbered stage by stage.

    Attributes:
        begin: (stages + 1,) first family of each stage, and F.
        count: (F,) number of children.
        row: (F,) place of the first child among the nodes of its stage.
        parent: (F,) family of the parent node; -1 for the children of the root.
        offset: (F,) place of the parent node in its family.
        runs: for each stage, its run of each batch.
    """

    begin: NDArray[np.int64]
    count: NDArray[np.uint16]
    row: NDArray[np.uint32]
    parent: NDArray[np.int32]
    offset: NDArray[np.uint16]
    runs: list[dict[int, Run]]

    @property
    def nodes(self) -> int:
        """Number of nodes: the root, and all children."""
        return 1 + int(self.count.sum(dtype=np.int64))

    def starts(self, sequence: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Return (F,) the place of the first child of each family, for families in this sequence."""
        start = np.empty(len(sequence), np.uint32)
        ordered = self.count[sequence].astype(np.uint32)
        start[sequence] = np.cumsum(ordered, dtype=np.uint32) - ordered + np.uint32(1)
        return start

    def families_at(self, start: NDArray[np.uint32]) -> NDArray[np.int32]:
        """Return (nodes,) the family of the children of each node, -1 for a leaf; `start` is from `starts`."""
        at = np.full(self.nodes, -1, np.int32)
        place = start[self.parent]
        place += self.offset
        place[self.parent < 0] = 0
        at[place] = np.arange(len(start), dtype=np.int32)
        return at


def put_order(job: Job, *, threads: int, progress: Progress) -> None:
    """Order the nodes, as a task; put the plan of each window, then the number of nodes and of levels."""
    links = _links(job)
    levels = 1
    sequence, done = np.empty(len(links.count), np.uint32), 0  # the families sorted by batch, then by key
    for families in _merged(job.store, links.runs, links.begin):
        sequence[done : done + len(families)] = families
        done += len(families)
        progress("ordering", done, 2 * len(sequence), "family")
    if len(sequence):
        by_place = links.families_at(links.starts(sequence))
        by_place = by_place[by_place >= 0]  # the families in the order of their parent nodes
        if job.in_chunks:
            del sequence  # memory for what follows
        with on_threads(threads):
            levels, arranged = _arranged(job, links, by_place, progress)
        del by_place
        if arranged is not None:
            sequence = arranged
    start = links.starts(sequence)
    at, nodes = links.families_at(start), links.nodes
    for window, part in enumerate(blocks_of(nodes, WINDOW_NODES)):
        _put_window(job, window, part, links, sequence, start, at)
        progress("ordering", nodes + part.stop, 2 * nodes, "node")
    job.store.put(ORDER, {"counts": np.array([nodes, levels], np.int64)})


def _links(job: Job) -> _Links:
    begin = np.cumsum([0, *job.families])
    total = int(begin[-1])
    count, row, offset = np.empty(total, np.uint16), np.empty(total, np.uint32), np.zeros(total, np.uint16)
    parent, runs = np.full(total, -1, np.int32), []
    for stage, length in enumerate(job.families):
        families = job.store.get(families_of(stage), ["batch", "count", "family"])
        here = slice(begin[stage], begin[stage + 1])
        count[here] = families["count"]
        row[here] = np.cumsum(families["count"], dtype=np.int64) - families["count"]
        batch = families["batch"]
        ends = [*(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(batch)]
        runs.append({int(batch[a]): (stage, a, b) for a, b in zip([0, *ends], ends, strict=False) if a < b})
        inner = np.flatnonzero(families["family"] != NO_FAMILY)
        family = families["family"][inner]
        child = begin[family >> STAGE_BITS] + (family & ((1 << STAGE_BITS) - 1))
        mine = np.repeat(np.arange(length, dtype=np.int32), families["count"])[inner]
        parent[child] = begin[stage] + mine
        offset[child] = inner - row[here][mine]
    return _Links(begin, count, row, parent, offset, runs)


def _arranged(
    job: Job, links: _Links, by_place: NDArray[np.int32], progress: Progress
) -> tuple[int, NDArray[np.uint32] | None]:
    """Return the number of levels, and the sequence of families in the output; None for that of the builder.

    Args:
        by_place: (F,) families in the order of their parent nodes.
    """
    place = np.empty(len(by_place), np.int32)
    place[by_place] = np.arange(len(by_place), dtype=np.int32)
    parent = links.parent[by_place]
    inner = parent >= 0
    parent[inner] = place[parent[inner]]
    del inner
    size, count = _of_all(job, "size", place), links.count[by_place]
    depth, _ = find_limits(parent, size)
    levels = int(depth.max()) + 2
    del depth
    if job.in_chunks:
        center = _of_all(job, "center", place)
        del place
        order = family_order(parent, count, center, size, most=MOST_FAMILIES, progress=progress)
        return levels, by_place[order].astype(np.uint32)
    if BUILDERS[job.settings.method].in_bands:
        return levels, by_place[band_order(parent, count, size)].astype(np.uint32)
    return levels, None


def _of_all(job: Job, key: str, place: NDArray[np.int32]) -> FloatArray:
    """Read a column of the families of all stages, and put each family at its place."""
    column, begin = np.empty((len(place), *job.store.shape(families_of(0), key)[1:]), np.float32), 0
    for stage, length in enumerate(job.families):
        column[place[begin : begin + length]] = job.store.get(families_of(stage), [key])[key]
        begin += length
    return column


def _put_window(
    job: Job,
    window: int,
    part: slice,
    links: _Links,
    sequence: NDArray[np.uint32],
    start: NDArray[np.uint32],
    at: NDArray[np.int32],
) -> None:
    """Put the plan of a window of nodes.

    For families overlapping the window, grouped by stage: `stages`, the first family of each stage; `row`, the place of
    the family's first child in the window among the nodes of its stage; `count`, of children in the window; `target`,
    their place there. For nodes with children: `owner`, the place in the window; `child_start`; `child_count`.
    """
    begin, end = (
        bisect.bisect_right(sequence, place, key=lambda number: int(start[number]))
        for place in (part.start, part.stop - 1)
    )
    number = np.sort(sequence[max(0, begin - 1) : end])
    row, count, target = (column[number].astype(np.int64) for column in (links.row, links.count, start))
    target -= part.start
    before = np.maximum(-target, 0)
    row, count, target = row + before, count - before, target + before
    count = np.minimum(count, part.stop - part.start - target)
    mine = at[part]
    owner = np.flatnonzero(mine >= 0)
    job.store.put(
        window_of(window),
        {
            "stages": np.searchsorted(number, links.begin),
            "row": row.astype(np.uint32),
            "count": count.astype(np.uint16),
            "target": target.astype(np.uint32),
            "owner": owner.astype(np.uint32),
            "child_start": start[mine[owner]],
            "child_count": links.count[mine[owner]],
        },
    )


def _merged(store: Store, batches: list[dict[int, Run]], begin: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers of all families, sorted by batch and key, in pieces that fit into memory."""
    for batch in sorted({batch for runs in batches for batch in runs}):
        runs = [runs[batch] for runs in batches if batch in runs]
        words = max(store.shape(families_of(stage), "key")[1] for stage, _, _ in runs)
        for parts in _ranges(store, runs, words):
            key = np.concatenate([_keys(store, run, words) for run in parts])
            number = np.concatenate([np.arange(start, stop) + begin[stage] for stage, start, stop in parts])
            yield number[np.lexsort(key.T[::-1])]


def _ranges(store: Store, runs: list[Run], words: int) -> Iterator[list[Run]]:
    """Cut runs at common keys, and yield the parts of each range of keys; a range can be sorted at once."""
    pieces = -(-sum(stop - start for _, start, stop in runs) // MERGED)
    if pieces == 1:
        yield runs
        return
    ends = np.concatenate([_keys(store, (stage, k, k + 1), words) for stage, a, b in runs for k in (a, b - 1)])
    # Cut by the first word that differs, as families with the same word must stay together.
    word = int(np.argmax((ends != ends[0]).any(axis=0)))
    columns = [_keys(store, run, words)[:, word].copy() for run in runs]
    probes = np.sort(np.concatenate([column[:: max(1, MERGED // PROBES)] for column in columns]))
    pivots = np.unique(probes[[len(probes) * piece // pieces for piece in range(1, pieces)]])
    cuts = [[0, *np.searchsorted(column, pivots).tolist(), len(column)] for column in columns]
    for piece in range(len(pivots) + 1):
        parts = [(run[0], run[1] + cut[piece], run[1] + cut[piece + 1]) for run, cut in zip(runs, cuts, strict=True)]
        if parts := [part for part in parts if part[1] < part[2]]:
            yield parts


def _keys(store: Store, run: Run, words: int) -> NDArray[np.uint64]:
    """Read the keys of a run, padded to this many words."""
    stage, start, stop = run
    key = store.rows(families_of(stage), "key", start, stop)
    return np.pad(key, ((0, 0), (words - key.shape[1], 0)))


def node_stream(job: Job, count: int) -> Reader:
    """Return a reader of the nodes of an ordered tree."""
    store, width = job.store, width_of(job.sh_degree)

    def fill(target: RowBuffer, threads: int, progress: Progress) -> None:
        splats, tree = _read(store, width, target.start, target.stop, threads)
        assert target.tree is not None
        for name in COLUMNS:
            getattr(target.splats, name)[:] = getattr(splats, name)
        target.tree.child_count[:], target.tree.child_start[:] = tree.child_count, tree.child_start

    up = job.settings.up or job.stream.up
    if up is not None and job.settings.transform is not None:
        up = rotated_axis(up, job.settings.transform.rotation)
    return Reader(count, job.sh_degree, "", fill, job.stream.antialiased, up=up, has_tree=True)


def encode(job: Job, start: int, stop: int, *, threads: int, progress: Progress) -> None:
    """Encode the nodes of a window, as a task; put the arrays of its chunks as NUMBER.NAME."""
    assert job.encoder is not None
    encoder = job.encoder
    splats, tree = _read(job.store, width_of(job.sh_degree), start, stop, threads)

    def encoded(part: slice) -> dict[str, NDArray[np.generic]]:
        return encoder.encode(splats.take(part), tree.rows(part), start + part.start)

    arrays: dict[str, NDArray[np.generic]] = {}
    for number, chunk in enumerate(ordered_map(encoded, windows_of(stop - start), threads)):
        arrays |= {f"{number}.{name}": array for name, array in chunk.items()}
    job.store.put(encoded_of(start // WINDOW_NODES), arrays)


def encoded_array(store: Store, number: int, name: str) -> NDArray[np.generic]:
    """Read an encoded array of a chunk."""
    window, place = divmod(number, len(windows_of(WINDOW_NODES)))
    key = f"{place}.{name}"
    return store.get(encoded_of(window), [key])[key]


def _read(store: Store, width: int, start: int, stop: int, threads: int = 1) -> tuple[Splats, LodTree]:
    """Read a range of nodes from rows of this width; `child_start` counts from the first node of the whole tree."""
    parts = []
    for window in range(start // WINDOW_NODES, -(-stop // WINDOW_NODES)):
        first = window * WINDOW_NODES
        rows, tree = _read_window(store, width, window)
        here = slice(max(start - first, 0), stop - first)
        parts.append((rows[here], tree.child_count[here], tree.child_start[here]))
    rows, count, child_start = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    return splats_of(rows, threads), LodTree(count.copy(), child_start.copy())


def _read_window(store: Store, width: int, window: int) -> tuple[Rows, LodTree]:
    """Gather the nodes of a window by the plan of `_put_window`."""
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
        length = count[here]
        step = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
        place = np.repeat(row[here], length) + step
        rows[np.repeat(target[here], length) + step] = store.rows_at(families_of(stage), "rows", place)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    tree.child_count[plan["owner"]] = plan["child_count"]
    tree.child_start[plan["owner"]] = plan["child_start"]
    return rows, tree


#: (N, `width_of`) float32: the columns of splats side by side, in the order of `COLUMNS`.
Rows = NDArray[np.float32]


def rows_of(splats: Splats, threads: int = 1, rows: Rows | None = None) -> Rows:
    """Pack splats into rows; None for new ones."""
    if rows is None:
        rows = np.empty((len(splats), width_of(splats.sh_degree)), np.float32)
    _copy(splats, rows, threads, to_rows=True)
    return rows


def splats_of(rows: Rows, threads: int = 1) -> Splats:
    """Unpack rows."""
    splats = Splats.empty(len(rows), degree_of((rows.shape[1] - width_of(0)) // 3))
    _copy(splats, rows, threads, to_rows=False)
    return splats


def _copy(splats: Splats, rows: Rows, threads: int, *, to_rows: bool) -> None:
    columns = [getattr(splats, name).reshape(len(splats), -1) for name in COLUMNS if getattr(splats, name).size]
    parts = np.split(rows, np.cumsum([column.shape[1] for column in columns])[:-1], axis=1)  # views

    def copy(block: slice) -> None:
        for column, part in zip(columns, parts, strict=False):  # without rows, there are no columns
            if to_rows:
                part[block] = column[block]
            else:
                column[block] = part[block]

    for_blocks(copy, len(rows), threads)
