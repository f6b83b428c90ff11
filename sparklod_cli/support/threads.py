"""How many threads work is done on: the one place that says so, to pools and to kernels.

A function of the API takes `threads`, None for all processors. It hands the number to what has pools of its own
(`parallel.ordered_map`), and runs kernels inside `on_threads`, which leaves numba as it was.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from .parallel import processors


def thread_count(threads: int | None) -> int:
    """The number of threads; None stands for all processors.

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
    """Runs kernels that this thread calls inside on so many threads, and gives the number.

    Raises:
        ValueError: it is less than 1.
    """
    from . import jit  # numba takes half a second to load

    count, before = thread_count(threads), jit.threads_in_use()
    jit.use_threads(count)
    try:
        yield count
    finally:
        jit.use_threads(before)
