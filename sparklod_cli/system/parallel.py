"""Blocks of rows and other items that are processed on several threads, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

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
