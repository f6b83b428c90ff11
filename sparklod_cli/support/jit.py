"""Compiles kernels; the only module that configures numba."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

#: How long OpenMP's threads spin while they wait for one another at the end of a parallel loop. By default they
#: spin for milliseconds, which on a busy machine takes the processor from the thread they wait for: four concurrent
#: bakes then take 1.5 times as long as four in sequence (docs/decisions/2026-11-21-kernels.md). The variables are read
#: when numba starts its threads; variables that are already set are left unchanged.
WAIT_SETTINGS = {
    "GOMP_SPINCOUNT": "1000",  # GNU: iterations, about 20 microseconds
    "KMP_BLOCKTIME": "0",  # LLVM and Intel: milliseconds
}
if "OMP_WAIT_POLICY" not in os.environ:
    for _name, _value in WAIT_SETTINGS.items():
        os.environ.setdefault(_name, _value)

import numba  # noqa: E402
from numba import prange as prange  # noqa: E402
from numba.core import event  # noqa: E402

from .jit_cache import KernelCache, Trouble, is_whole, pattern_of, stem_of  # noqa: E402
from .kernel_sources import PACKAGE, digest_of, sources_of  # noqa: E402

#: Called with the name of a kernel when its compilation begins, and with its duration in seconds when it ends.
Begun = Callable[[str], None]
Done = Callable[[float], None]

#: Least number of rows for which several threads are used: with fewer, one thread finishes before another wakes up.
#: Chosen; no difference was measured up to 65,536 (docs/decisions/2026-11-21-kernels.md).
PARALLEL_ROWS = 4096


def _cache_folder() -> Path | None:
    """The folder for compiled code, or None if none is writable.

    Its name is a digest of the code that compiles; the names of files depend on the sources of their kernels.
    """
    digest = digest_of(sources_of(Path(__file__)))
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [PACKAGE / "__pycache__"]
    if not given:
        with contextlib.suppress(RuntimeError):  # no home directory
            places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sparklod")
    for place in places:
        folder = place / f"kernels-{digest}"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder
    return None


#: The folder for compiled code; None if kernels have to be compiled in every process.
CACHE_FOLDER = _cache_folder()


def kernel(
    *, parallel: bool = False, nogil: bool = False, inline: bool = False, contract: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorator for a compiled function.

    Without fastmath, because results must not depend on the number of threads. Machine code is cached in the
    package, or in the user's cache directory if the package is read-only; if neither is writable, every run compiles.

    Args:
        parallel: the function has loops that run on the threads of `use_threads`.
        nogil: releases the GIL, so that other Python threads can run.
        inline: always inlines the function into its callers, which LLVM does not always do by itself.
        contract: allows fused multiply-add, which rounds once instead of twice, on processors that have it.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        compiled: Any = numba.njit(
            error_model="numpy",
            parallel=parallel,
            nogil=nogil,
            inline="always" if inline else "never",
            fastmath={"contract"} if contract else False,
        )(function)
        if CACHE_FOLDER is not None and hasattr(compiled, "enable_caching"):  # not with NUMBA_DISABLE_JIT
            compiled._cache = KernelCache(function, CACHE_FOLDER, _report_trouble)
        return compiled

    return decorate


def is_cached(name: str) -> bool:
    """Whether this process can load the compiled code of a kernel, which is named "module.function"."""
    if CACHE_FOLDER is None:
        return False
    sources = PACKAGE.glob(f"*/kernels/{name.partition('.')[0]}.py")
    with contextlib.suppress(OSError):
        files = (file for source in sources for file in CACHE_FOLDER.glob(pattern_of(name, source)))
        return any(file.is_file() and is_whole(file.read_bytes()) for file in files)
    return False


def use_threads(count: int) -> None:
    """Runs kernels on `count` threads, or on all of numba's threads if it has fewer."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Runs kernels inside on one thread if there are fewer than PARALLEL_ROWS rows; yields the number of threads.

    Waking the other threads takes longer than processing a few thousand rows; on a busy machine, where the threads
    sleep, a thousand times longer.
    """
    threads = numba.get_num_threads()
    use_threads(1 if rows < PARALLEL_ROWS else threads)
    try:
        yield numba.get_num_threads()
    finally:
        use_threads(threads)


#: Callbacks for messages about a cache that does not work.
_trouble_listeners: list[Trouble] = []


def _report_trouble(text: str) -> None:
    for report in _trouble_listeners:
        report(text)


class _OnCompile(event.Listener):
    """Reports the compilation of kernels called from Python, not of the kernels that those call."""

    def __init__(self, begun: Begun, done: Done) -> None:
        self._begun, self._done = begun, done
        self._depth, self._since = 0, 0.0

    def on_start(self, event: event.Event) -> None:
        self._depth += 1  # numba compiles on one thread at a time
        if self._depth == 1:
            self._since = time.perf_counter()
            self._begun(stem_of(event.data["dispatcher"].py_func))

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._done(time.perf_counter() - self._since)


def listen(begun: Begun, done: Done, trouble: Trouble) -> Callable[[], None]:
    """Reports what happens when kernels are called for the first time.

    Args:
        begun: called with the name of each kernel that has to be compiled because it is not in the cache.
        done: called with the duration of the compilation in seconds.
        trouble: called with a one-line message if the cache cannot be used.

    Returns:
        a function that stops the reports.
    """
    listener = _OnCompile(begun, done)
    event.register("numba:compile", listener)
    _trouble_listeners.append(trouble)

    def stop() -> None:
        event.unregister("numba:compile", listener)
        _trouble_listeners.remove(trouble)

    return stop


def threads_in_use() -> int:
    """The number of threads that kernels run on."""
    threads: int = numba.get_num_threads()
    return threads


def threading_layer() -> str:
    """The layer that runs parallel loops: omp, tbb or workqueue. Starts its threads.

    Raises:
        ValueError: no threading layer can be loaded.
    """
    from numba.np.ufunc.parallel import _launch_threads

    _launch_threads()
    layer: str = numba.threading_layer()
    return layer
