"""Blocks of rows that are processed on several threads, and the number of these.

A function of the API takes `threads`, None for all processors. It passes the number to functions with their own pools
(`ordered_map`), and runs kernels inside `on_threads`, which restores numba's setting.
"""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Rows of a block: few enough for temporaries to stay in the processor's cache, enough for the
#: overhead of the interpreter to stay small.
BLOCK_ROWS = 1 << 14


def processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def ordered_map(work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Generator[Result, None, None]:
    """Yield the results of `work` in the order of `items`, computed up to `threads` at a time.

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
    """Return slices of `size` rows that cover `rows`; the last may be shorter."""
    return [slice(start, min(start + size, rows)) for start in range(0, rows, size)]


def for_blocks(work: Callable[[slice], None], rows: int, threads: int, done: Callable[[int], None]) -> None:
    """Call `work` with slices that cover `rows`, and `done` with the number of rows finished so far, ascending."""

    def run(part: slice) -> int:
        work(part)
        return part.stop

    for stop in ordered_map(run, blocks_of(rows), threads):
        done(stop)


def thread_count(threads: int | None) -> int:
    """Return the number of threads, that of all processors for None; raise `ValueError` below 1."""
    if threads is None:
        return processors()
    if threads < 1:
        raise ValueError(f"threads is {threads}; give 1 or more, or None for all processors")
    return threads


@contextlib.contextmanager
def on_threads(threads: int | None) -> Iterator[int]:
    """Run kernels that this thread calls inside on so many threads; yield the number. `ValueError` if it is below 1."""
    from . import jit  # loads numpy

    count, before = thread_count(threads), jit.threads_in_use()
    jit.use_threads(count)
    try:
        yield count
    finally:
        jit.use_threads(before)
