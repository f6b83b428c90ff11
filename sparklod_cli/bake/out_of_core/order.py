"""The order of the nodes of a tree, and where each of its windows finds them."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...lod.builders import BUILDERS
from ...lod.chunk_order import MOST_FAMILIES, family_order
from ...lod.families import band_order
from ...lod.kernels.tree_links import find_limits
from ...lod.stage_records import NO_FAMILY, STAGE_BITS
from ...model.lod_tree import CHUNK_NODES
from ...model.splats import FloatArray
from ...system.progress import Progress
from ...system.threads import blocks_of, on_threads
from .job import ORDER, Job, families_of, window_of
from .store import Store

#: Nodes of a window that is gathered in one go, whole chunks: 30 MB without SH, 120 MB with SH of degree 3. Chosen.
WINDOW_NODES = 8 * CHUNK_NODES

#: Families whose keys are in memory at once: some 100 MB. Chosen.
MERGED = 1 << 22

#: Keys of so many families that are looked at to cut them in ranges of about as many. Chosen.
PROBES = 256

#: A range of families of a stage: the stage, the first one and the end.
Run = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class _Links:
    """Links between F families, which are numbered stage by stage.

    Attributes:
        begin: (stages + 1,) number of the first family of each stage, and F.
        count: (F,) children.
        row: (F,) place of the first child among the nodes of its stage.
        parent: (F,) family of the node whose children they are; -1 for the children of the root.
        offset: (F,) place of that node in its family.
        runs: of each stage, by batch.
    """

    begin: NDArray[np.int64]
    count: NDArray[np.uint16]
    row: NDArray[np.uint32]
    parent: NDArray[np.int32]
    offset: NDArray[np.uint16]
    runs: list[dict[int, Run]]

    @property
    def nodes(self) -> int:
        """The root, and all children."""
        return 1 + int(self.count.sum(dtype=np.int64))

    def starts(self, sequence: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Return (F,) where the children of each family are, if families are in this order."""
        start = np.empty(len(sequence), np.uint32)
        ordered = self.count[sequence].astype(np.uint32)
        start[sequence] = np.cumsum(ordered, dtype=np.uint32) - ordered + np.uint32(1)
        return start

    def families_at(self, start: NDArray[np.uint32]) -> NDArray[np.int32]:
        """Return (nodes,) the family of the children of each node, if families begin there; -1 for a leaf."""
        at = np.full(self.nodes, -1, np.int32)
        place = start[self.parent]
        place += self.offset
        place[self.parent < 0] = 0
        at[place] = np.arange(len(start), dtype=np.int32)
        return at


def put_order(job: Job, *, threads: int, progress: Progress) -> None:
    """Order the nodes; a task. Results: what each window is read by; at last the number of nodes and of levels."""
    links = _links(job)
    levels = 1
    sequence = _by_key(job, links, progress)
    if len(sequence):
        by_place = _by_place(links, sequence)
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


def _by_key(job: Job, links: _Links, progress: Progress) -> NDArray[np.uint32]:
    """Return (F,) the families by batch, and then by key."""
    sequence, done = np.empty(len(links.count), np.uint32), 0
    for some in _merged(job.store, links.runs, links.begin):
        sequence[done : done + len(some)] = some
        done += len(some)
        progress("ordering", done, 2 * len(sequence), "family")
    return sequence


def _by_place(links: _Links, sequence: NDArray[np.uint32]) -> NDArray[np.int32]:
    """Return (F,) the families in the order of their parents, in a tree whose families are in this sequence."""
    at = links.families_at(links.starts(sequence))
    return at[at >= 0]


def _links(job: Job) -> _Links:
    """Read the families of all stages."""
    begin = np.cumsum([0, *job.families])
    total = int(begin[-1])
    count, row, offset = np.empty(total, np.uint16), np.empty(total, np.uint32), np.zeros(total, np.uint16)
    parent, runs = np.full(total, -1, np.int32), []
    for stage, length in enumerate(job.families):
        found = job.store.get(families_of(stage), ["batch", "count", "family"])
        here = slice(begin[stage], begin[stage + 1])
        count[here] = found["count"]
        row[here] = np.cumsum(found["count"], dtype=np.int64) - found["count"]
        runs.append(_runs_of(stage, found["batch"]))
        inner = np.flatnonzero(found["family"] != NO_FAMILY)
        family = found["family"][inner]
        child = begin[family >> STAGE_BITS] + (family & ((1 << STAGE_BITS) - 1))
        mine = np.repeat(np.arange(length, dtype=np.int32), found["count"])[inner]
        parent[child] = begin[stage] + mine
        offset[child] = inner - row[here][mine]
    return _Links(begin, count, row, parent, offset, runs)


def _arranged(
    job: Job, links: _Links, by_place: NDArray[np.int32], progress: Progress
) -> tuple[int, NDArray[np.uint32] | None]:
    """Return the levels of the tree, and the order of its families in the output, if that is not the builder's.

    Args:
        by_place: (F,) the families in the order of the nodes whose children they are.
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
    """Return a column of the families of all stages, each at its place."""
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
    """Put what a window is read by.

    Families whose children are in it, as far as they are, stage by stage: `stages`, where those of each stage begin,
    `row`, `count` and `target`, the first one's place in the window. Its nodes with children: `owner`, places in the
    window, `child_start`, `child_count`.
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


def _runs_of(stage: int, batch: NDArray[np.int32]) -> dict[int, Run]:
    """Return the families of each batch of a stage."""
    ends = [*(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(batch)]
    return {int(batch[a]): (stage, a, b) for a, b in zip([0, *ends], ends, strict=False) if a < b}


def _merged(store: Store, batches: list[dict[int, Run]], begin: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers of all families in the order of the tree, some at a time."""
    for batch in sorted({batch for runs in batches for batch in runs}):
        runs = [runs[batch] for runs in batches if batch in runs]
        words = max(store.shape(families_of(stage), "key")[1] for stage, _, _ in runs)
        for some in _ranges(store, runs, words):
            key = np.concatenate([_keys(store, run, words) for run in some])
            number = np.concatenate([np.arange(start, stop) + begin[stage] for stage, start, stop in some])
            yield number[np.lexsort(key.T[::-1])]


def _ranges(store: Store, runs: list[Run], words: int) -> Iterator[list[Run]]:
    """Yield runs cut at the same keys, so that each range is small enough to be sorted at once."""
    pieces = -(-sum(stop - start for _, start, stop in runs) // MERGED)
    if pieces == 1:
        yield runs
        return
    ends = np.concatenate([_keys(store, (stage, k, k + 1), words) for stage, a, b in runs for k in (a, b - 1)])
    # The first word in which they differ decides: families that are the same there stay together.
    word = int(np.argmax((ends != ends[0]).any(axis=0)))
    columns = [_keys(store, run, words)[:, word].copy() for run in runs]
    probes = np.sort(np.concatenate([column[:: max(1, MERGED // PROBES)] for column in columns]))
    pivots = np.unique(probes[[len(probes) * piece // pieces for piece in range(1, pieces)]])
    cuts = [[0, *np.searchsorted(column, pivots).tolist(), len(column)] for column in columns]
    for piece in range(len(pivots) + 1):
        parts = [(run[0], run[1] + cut[piece], run[1] + cut[piece + 1]) for run, cut in zip(runs, cuts, strict=True)]
        if some := [part for part in parts if part[1] < part[2]]:
            yield some


def _keys(store: Store, run: Run, words: int) -> NDArray[np.uint64]:
    """Return the keys of a run, of so many words."""
    stage, start, stop = run
    key = store.rows(families_of(stage), "key", start, stop)
    return np.pad(key, ((0, 0), (words - key.shape[1], 0)))
