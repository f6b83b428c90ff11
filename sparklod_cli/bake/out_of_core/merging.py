"""Merges the families of all stages into one sequence: by batch, and then by key."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .contracts import Store
from .job import families_of

#: Families whose keys are in memory at once: some 100 MB. Chosen.
MERGED = 1 << 22

#: Keys of so many families that are looked at to cut them in ranges of about as many. Chosen.
PROBES = 256

#: A range of families of a stage: the stage, the first one and the end.
Run = tuple[int, int, int]


def runs_of(stage: int, batch: NDArray[np.int32]) -> dict[int, Run]:
    """The families of each batch of a stage."""
    ends = [*(np.flatnonzero(np.diff(batch)) + 1).tolist(), len(batch)]
    return {int(batch[a]): (stage, a, b) for a, b in zip([0, *ends], ends, strict=False) if a < b}


def merged(store: Store, batches: list[dict[int, Run]], begin: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """The numbers of all families in the order of the tree, some at a time.

    Args:
        store: of the families.
        batches: of each stage, by its number: the families of each batch.
        begin: number of the first family of each stage.
    """
    for batch in sorted({batch for runs in batches for batch in runs}):
        runs = [runs[batch] for runs in batches if batch in runs]
        words = max(store.shape(families_of(stage), "key")[1] for stage, _, _ in runs)
        for some in _ranges(store, runs, words):
            key = np.concatenate([_keys(store, run, words) for run in some])
            number = np.concatenate([np.arange(start, stop) + begin[stage] for stage, start, stop in some])
            yield number[np.lexsort(key.T[::-1])]


def _ranges(store: Store, runs: list[Run], words: int) -> Iterator[list[Run]]:
    """Runs cut at the same keys, so that each range is small enough to be sorted at once."""
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
    """The keys of a run, of so many words."""
    stage, start, stop = run
    key = store.rows(families_of(stage), "key", start, stop)
    return np.pad(key, ((0, 0), (words - key.shape[1], 0)))
