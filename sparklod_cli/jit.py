"""How sparklod compiles: the one place that configures numba."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba.core import event

SMALL = 4096  # rows that one thread works through before another would have woken up


def kernel(*, parallel: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Decorator for a compiled function.

    No fastmath: results must not depend on the number of threads. The machine code is cached beside the source, or in
    the user's cache directory where the package is read-only; where neither can be written it is compiled every time.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled: Any = numba.njit(error_model="numpy", parallel=parallel)(function)
        with contextlib.suppress(RuntimeError):  # "no locator available": nowhere to put a cache
            compiled.enable_caching()
        return compiled

    return decorate


def use_threads(count: int) -> None:
    """Runs kernels on `count` threads, or as many as there are if that is fewer."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Runs kernels on one thread inside where there is little to do, and tells how many threads that leaves.

    Waking the other threads costs more than a few thousand rows, and on a busy machine, where they are not awake to be
    waited for, a thousand times more.
    """
    threads = numba.get_num_threads()
    use_threads(1 if rows < SMALL else threads)
    try:
        yield numba.get_num_threads()
    finally:
        use_threads(threads)


class _OnCompile(event.Listener):
    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback: Callable[[], None] | None = callback

    def on_start(self, event: event.Event) -> None:
        callback, self._callback = self._callback, None
        if callback:
            callback()

    def on_end(self, event: event.Event) -> None:
        pass


def on_first_compile(callback: Callable[[], None]) -> None:
    """Calls back when a kernel is compiled because no cache has it, the first time only."""
    event.register("numba:compile", _OnCompile(callback))
