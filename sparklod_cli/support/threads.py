"""The number of threads of thread pools and kernels.

A function of the API takes `threads`, None for all processors. It passes the number to functions with their own pools
(`parallel.ordered_map`), and runs kernels inside `on_threads`, which restores numba's setting.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from .parallel import processors


def thread_count(threads: int | None) -> int:
    """The number of threads; None means all processors.

    Raises:
        ValueError: it is less than 1.
    """
    if threads is None:
        return processors()
    if threads < 1:
        raise ValueError(f"threads is {threads}; give 1 or more, or None for all processors")
    return threads


@contextlib.contextmanager
def on_threads(threads: int | None) -> Iterator[int]:
    """A context in which kernels called by this thread run on this many threads; yields the number.

    Raises:
        ValueError: it is less than 1.
    """
    from . import jit  # loads numpy

    count, before = thread_count(threads), jit.threads_in_use()
    jit.use_threads(count)
    try:
        yield count
    finally:
        jit.use_threads(before)
