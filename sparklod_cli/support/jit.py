"""Compiling kernels: the one place that configures numba."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

#: How long OpenMP's threads spin while they wait for one another at the end of a parallel loop. By default that is
#: milliseconds, which on a busy machine takes the processor from the thread that is waited for: four bakes at once then
#: take 1.5 times as long as one after another (docs/decisions/2026-11-21-kernels.md). The variables are read when numba
#: starts its threads; those that are set already are left alone.
WAITING = {
    "GOMP_SPINCOUNT": "1000",  # GNU's: iterations, some 20 microseconds
    "KMP_BLOCKTIME": "0",  # LLVM's and Intel's: milliseconds
}
if "OMP_WAIT_POLICY" not in os.environ:
    for _name, _value in WAITING.items():
        os.environ.setdefault(_name, _value)

import numba  # noqa: E402
from numba.core import event  # noqa: E402

from .jit_cache import KernelCache, Trouble, is_whole, pattern_of, stem_of  # noqa: E402

#: Called with the name of a kernel when its compilation begins, and with the seconds that it took when it ends.
Begun = Callable[[str], None]
Done = Callable[[float], None]

#: Rows from which on work is spread over threads: one thread is through with fewer before another has woken up. Chosen;
#: no difference was measured up to 65,536 (docs/decisions/2026-11-21-kernels.md).
PARALLEL_ROWS = 4096

#: Sources of compiled code: kernels, and the modules whose constants and functions they use. They name the cache.
SOURCES = (
    "model/gaussian.py",
    "model/lod_tree.py",
    "model/sh.py",
    "model/splats.py",
    "support/atomic.py",
    "support/defaults.py",
    "support/errors.py",
    "support/fast_math.py",
    "support/jit.py",
    "support/jit_cache.py",
    "lod/kernels/*.py",
    "render/kernels/*.py",
)


def _cache_folder() -> Path | None:
    """The folder for compiled code, or None where none can be written.

    numba's own cache compares the file of a kernel alone with the source that it compiled. A kernel also consists of
    the kernels that it calls and the constants that it uses, so the folder is named by a digest of all SOURCES.
    """
    package = Path(__file__).parents[1]
    sources = [path for pattern in SOURCES for path in sorted(package.glob(pattern))]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [package / "__pycache__"]
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

    Without fastmath, as results must not depend on the number of threads. Machine code is cached beside the source, or
    in the user's cache directory if the package is read-only; if neither can be written, each process compiles it.

    Args:
        parallel: the function has loops that run on the threads of `use_threads`.
        nogil: other threads of this process may run meanwhile.
        inline: the function becomes part of the kernels that call it, which LLVM does not always do by itself.
        contract: a product and a sum may be rounded once instead of twice, on processors that can.
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
            compiled._cache = KernelCache(function, CACHE_FOLDER, _tell_trouble)
        return compiled

    return decorate


def is_cached(name: str) -> bool:
    """Whether this process can load the compiled code of a kernel, which is named "module.function"."""
    if CACHE_FOLDER is None:
        return False
    with contextlib.suppress(OSError):
        return any(path.is_file() and is_whole(path.read_bytes()) for path in CACHE_FOLDER.glob(pattern_of(name)))
    return False


def use_threads(count: int) -> None:
    """Runs kernels on `count` threads, or on all that numba has if those are fewer."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Runs kernels inside on one thread if there are fewer than PARALLEL_ROWS rows; yields the number of threads.

    Waking the other threads takes longer than a few thousand rows do, and on a busy machine, where they sleep, a
    thousand times longer.
    """
    threads = numba.get_num_threads()
    use_threads(1 if rows < PARALLEL_ROWS else threads)
    try:
        yield numba.get_num_threads()
    finally:
        use_threads(threads)


#: Called with what keeps the cache from working.
_troubled: list[Trouble] = []


def _tell_trouble(text: str) -> None:
    for tell in _troubled:
        tell(text)


class _OnCompile(event.Listener):
    """Reports the compilation of kernels that Python calls, not of those that they call."""

    def __init__(self, begun: Begun, done: Done) -> None:
        self._begun, self._done = begun, done
        self._depth, self._since = 0, 0.0

    def on_start(self, event: event.Event) -> None:
        self._depth += 1  # one thread at a time compiles
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
        begun: called with the name of each kernel that is compiled, as it is not in the cache; see `is_cached`.
        done: called with the seconds that took.
        trouble: called with a line on what keeps the cache from working.

    Returns:
        a function that ends the reports.
    """
    listener = _OnCompile(begun, done)
    event.register("numba:compile", listener)
    _troubled.append(trouble)

    def stop() -> None:
        event.unregister("numba:compile", listener)
        _troubled.remove(trouble)

    return stop


def threads_in_use() -> int:
    """The number of threads that kernels run on."""
    threads: int = numba.get_num_threads()
    return threads


def threading_layer() -> str:
    """The layer that runs parallel loops: omp, tbb or workqueue. Starts its threads.

    Raises:
        ValueError: none of them can be loaded.
    """
    from numba.np.ufunc.parallel import _launch_threads

    _launch_threads()
    layer: str = numba.threading_layer()
    return layer
