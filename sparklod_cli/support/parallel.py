"""Processes rows in blocks, on several threads."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Rows of a block: few enough for temporaries to stay in the processor's cache, enough for the
#: overhead of the interpreter to stay small.
BLOCK_ROWS = 1 << 14


def processors() -> int:
    """Number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def ordered_map(work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Generator[Result, None, None]:
    """The results of `work` in the order of `items`, computed up to `threads` at a time.

    Items are taken when they are needed, a few ahead of the workers, so that all of them need not fit into memory.
    """
    if threads == 1:
        yield from map(work, items)
        return
    pool = ThreadPoolExecutor(threads)
    pending: deque[Future[Result]] = deque()
    try:
        for item in items:
            pending.append(pool.submit(work, item))
            if len(pending) > 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def blocks_of(rows: int, size: int = BLOCK_ROWS) -> list[slice]:
    """Slices of `size` rows that cover `rows`; the last may be shorter."""
    return [slice(start, min(start + size, rows)) for start in range(0, rows, size)]


def for_blocks(work: Callable[[slice], None], rows: int, threads: int, done: Callable[[int], None]) -> None:
    """Calls `work` with slices that cover `rows`, and `done` with the number of rows finished so far, ascending."""

    def run(part: slice) -> int:
        work(part)
        return part.stop

    for stop in ordered_map(run, blocks_of(rows), threads):
        done(stop)
