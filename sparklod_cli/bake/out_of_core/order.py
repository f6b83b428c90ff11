"""The order of all families of a tree: by batch, and then by key."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...lod.stages.records import NO_FAMILY, STAGE_BITS
from ...support.progress import Progress
from .contracts import Arrays, Store
from .job import ORDER, Job, families_of

#: Families whose keys are in memory at once: some 100 MB. Chosen.
MERGED = 1 << 22

#: Keys of a stage that are looked at to cut its families in ranges of about as many. Chosen.
PROBES = 256

#: Where a range of families of a stage is: the stage, the first one and the end.
Run = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Order:
    """Where each of F families is; they are numbered stage by stage.

    Attributes:
        begin: (stages + 1,) int64 number of the first family of each stage, and F.
        count: (F,) uint16 children.
        row: (F,) uint32 the first child's place among the nodes of its stage.
        sequence: (F,) uint32 the families in the order of the tree.
        child_start: (F,) uint32 the first child's place in the tree.
        levels: 1 and the depth of the tree.
    """

    begin: NDArray[np.int64]
    count: NDArray[np.uint16]
    row: NDArray[np.uint32]
    sequence: NDArray[np.uint32]
    child_start: NDArray[np.uint32]
    levels: int

    def arrays(self) -> Arrays:
        """As arrays, of which `from_arrays` makes it again."""
        return {**vars(self), "levels": np.array([self.levels], np.int64)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Order:
        """The order of `arrays`."""
        return cls(**{**arrays, "levels": int(arrays["levels"][0])})  # type: ignore[arg-type]

    def numbers(self, family: NDArray[np.int64]) -> NDArray[np.int64]:
        """The numbers here of families that have numbers as `Families.family` has them."""
        return self.begin[family >> STAGE_BITS] + (family & ((1 << STAGE_BITS) - 1))


def put_order(job: Job, *, threads: int, progress: Progress) -> None:
    """A task. Result: the order."""
    begin = np.cumsum([0, *job.families])
    total = int(begin[-1])
    count, row = np.empty(total, np.uint16), np.empty(total, np.uint32)
    parent = np.full(total, -1, np.int32)
    batches = {}
    for stage, length in enumerate(job.families):
        here = slice(begin[stage], begin[stage + 1])
        found = job.store.get(families_of(stage), ["batch", "count", "family"])
        count[here] = found["count"]
        row[here] = np.cumsum(found["count"], dtype=np.int64) - found["count"]
        batches[stage] = _runs(stage, found["batch"], length)
        family = found["family"]
        inner = np.flatnonzero(family != NO_FAMILY)
        child = begin[family[inner] >> STAGE_BITS] + (family[inner] & ((1 << STAGE_BITS) - 1))
        parent[child] = begin[stage] + np.searchsorted(row[here], inner, "right") - 1
        progress("ordering", int(begin[stage + 1]), 2 * total, "family")
    sequence, done = np.empty(total, np.uint32), 0
    for some in _pieces(job.store, batches, begin):
        sequence[done : done + len(some)] = some
        done += len(some)
        progress("ordering", total + done, 2 * total, "family")
    order = Order(begin, count, row, sequence, starts_of(sequence, count), _levels(parent))
    job.store.put(ORDER, order.arrays())


def starts_of(sequence: NDArray[np.uint32], count: NDArray[np.uint16]) -> NDArray[np.uint32]:
    """(F,) where the children of each family are in the tree, after the root."""
    start = np.empty(len(sequence), np.uint32)
    ordered = count[sequence].astype(np.uint32)
    start[sequence] = np.cumsum(ordered, dtype=np.uint32) - ordered + 1
    return start


def _runs(stage: int, batch: NDArray[np.int32], length: int) -> dict[int, Run]:
    """The families of each batch of a stage."""
    first = np.flatnonzero(np.diff(batch, prepend=batch[0] - 1)) if length else np.empty(0, np.int64)
    ends = [*first[1:].tolist(), length]
    return {int(batch[a]): (stage, a, b) for a, b in zip(first.tolist(), ends, strict=False)}


def _pieces(store: Store, batches: dict[int, dict[int, Run]], begin: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """The numbers of all families in the order of the tree, some at a time."""
    for batch in sorted({batch for runs in batches.values() for batch in runs}):
        runs = [batches[stage][batch] for stage in sorted(batches) if batch in batches[stage]]
        for some in _ranges(store, runs):
            keys = [store.rows(families_of(stage), "key", start, stop) for stage, start, stop in some]
            words = max(key.shape[1] for key in keys)
            key = np.concatenate([np.pad(each, ((0, 0), (words - each.shape[1], 0))) for each in keys])
            number = np.concatenate([np.arange(start, stop) + begin[stage] for stage, start, stop in some])
            yield number[np.lexsort(key.T[::-1])]


def _ranges(store: Store, runs: list[Run]) -> Iterator[list[Run]]:
    """Runs cut at the same keys, so that each range is small enough to be sorted at once."""
    pieces = -(-sum(stop - start for _, start, stop in runs) // MERGED)
    if pieces == 1:
        yield runs
        return
    words = max(store.shape(families_of(stage), "key")[1] for stage, _, _ in runs)
    first = [_first_words(store, run, words) for run in runs]
    # Of each run as many as its share; families with the same first word stay together.
    probes = np.sort(np.concatenate([each[:: max(1, MERGED // PROBES)] for each in first]))
    pivots = np.unique(probes[[len(probes) * piece // pieces for piece in range(1, pieces)]])
    cuts = [[0, *np.searchsorted(each, pivots).tolist(), len(each)] for each in first]
    for piece in range(len(pivots) + 1):
        parts = [
            (stage, start + cut[piece], start + cut[piece + 1])
            for (stage, start, _), cut in zip(runs, cuts, strict=True)
        ]
        yield [part for part in parts if part[1] < part[2]]


def _first_words(store: Store, run: Run, words: int) -> NDArray[np.uint64]:
    """The first of so many words of the keys of a run."""
    stage, start, stop = run
    key = store.rows(families_of(stage), "key", start, stop)
    return key[:, 0] if key.shape[1] == words else np.zeros(len(key), np.uint64)


def _levels(parent: NDArray[np.int32]) -> int:
    """The number of levels of a tree whose families have these parents, -1 for that of the root."""
    depth, above = (parent >= 0).astype(np.int32), parent.copy()
    while (below := np.flatnonzero(above >= 0)).size:  # each round goes twice as far up
        ancestor = above[below]
        depth[below] += depth[ancestor]
        above[below] = above[ancestor]
    return int(depth.max(initial=-1)) + 2
