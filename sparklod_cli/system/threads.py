"""Threads: their number, ranges of rows for compiled kernels, and blocks of rows and other items, in order.

A function of the API takes `threads`, None for all processors. It passes the number to functions with their own pools
(`ordered_map`), and calls kernels inside `on_threads`.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

from .errors import SparklodError

#: Least number of rows for which several threads are used: with fewer, one thread finishes before another wakes up.
#: Chosen; no difference was measured up to 65,536 (benchmarks/notes/kernels.md).
PARALLEL_ROWS = 4096

#: Ranges for each thread, so that all of them end at about the same time although some rows take longer than others.
#: Chosen: a range costs some 10 microseconds.
RANGES = 8

#: Largest NUMBA_NUM_THREADS. Chosen: more than machines have processors, fewer than systems refuse to start.
MOST_THREADS = 1024

#: The number of threads of each Python thread, as `count`; not set where it is `most_threads`.
_setting = threading.local()

_pool: ThreadPoolExecutor | None = None
_making = threading.Lock()


def processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def most_threads() -> int:
    """Return the largest number of threads that kernels run on: NUMBA_NUM_THREADS, or that of processors."""
    return given_threads() or processors()


def given_threads() -> int | None:
    """Return NUMBA_NUM_THREADS, None if it is empty or not set; raise `SparklodError` if it is no number of threads."""
    given = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    if given and not (given.isdecimal() and 1 <= int(given) <= MOST_THREADS):
        raise SparklodError(
            f"NUMBA_NUM_THREADS is {given[:40]!r}; set it to a whole number from 1 to {MOST_THREADS:,}, or unset it"
        )
    return int(given) if given else None


def thread_count(threads: int | None) -> int:
    """Return the number of threads, that of all processors for None; raise `ValueError` below 1."""
    if threads is None:
        return processors()
    if threads < 1:
        raise ValueError(f"threads is {threads}; give 1 or more, or None for all processors")
    return threads


def threads_in_use() -> int:
    """Return the number of threads that kernels called by this thread run on."""
    return int(getattr(_setting, "count", 0)) or most_threads()


@contextlib.contextmanager
def on_threads(threads: int | None) -> Iterator[int]:
    """Run kernels that this thread calls inside on so many threads; yield the number. `ValueError` if it is below 1."""
    count, before = thread_count(threads), getattr(_setting, "count", 0)
    _setting.count = min(count, most_threads())
    try:
        yield count
    finally:
        _setting.count = before


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Run kernels inside on one thread if there are fewer than PARALLEL_ROWS rows; yield the number of threads.

    Waking the other threads takes longer than processing a few thousand rows; on a busy machine, where the threads
    sleep, a thousand times longer.
    """
    with on_threads(1 if rows < PARALLEL_ROWS else threads_in_use()) as count:
        yield count


def run_ranges(work: Callable[..., object], rows: int, *arguments: Any) -> None:
    """Call `work(start, stop, *arguments)` for ranges that cover `rows`, on `threads_in_use` threads.

    The calling thread is one of them. An exception of any, or an interruption, is raised when no range runs any more.

    Args:
        work: a function that releases the GIL, such as a kernel.
    """
    threads = min(threads_in_use(), rows)
    if threads < 2:
        work(0, rows, *arguments)
        return
    size = -(-rows // (threads * RANGES))
    starts = deque(range(0, rows, size))

    def run() -> None:
        while starts:
            try:
                start = starts.popleft()
            except IndexError:  # another thread was faster
                return
            work(start, min(start + size, rows), *arguments)

    pool = _pool_of_all()
    helpers = [pool.submit(run) for _ in range(threads - 1)]
    try:
        run()
    finally:
        starts.clear()
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


def _pool_of_all() -> ThreadPoolExecutor:
    """Return the threads that help in `run_ranges`; they are started when they are needed."""
    global _pool
    with _making:
        if _pool is None:
            _pool = ThreadPoolExecutor(most_threads(), "sparklod-rows")
        return _pool


def _after_fork() -> None:
    """Forget the threads of the parent, which a forked process does not have."""
    global _pool, _making
    _pool, _making = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


Item = TypeVar("Item")
Result = TypeVar("Result")

#: Rows of a block: few enough for temporaries to stay in the processor's cache, enough for the
#: overhead of the interpreter to stay small.
BLOCK_ROWS = 1 << 14


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


def for_blocks(work: Callable[[slice], None], rows: int, threads: int) -> None:
    """Call `work` with slices that cover `rows`."""
    deque(ordered_map(work, blocks_of(rows), threads), maxlen=0)
