"""How sparklod compiles: the one place that configures numba."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Threads of OpenMP wait for one another at the end of every parallel loop. By default they spin for milliseconds, which
# on a busy machine takes the processor from the very thread that they wait for: four bakes at once then take twice as
# long as one after another. These are read when numba first starts its threads; docs/performance.md has what was
# measured. Whoever sets one of them keeps it.
WAITING = {
    "GOMP_SPINCOUNT": "1000",  # GNU's: looks that often, some 20 microseconds, then sleeps
    "KMP_BLOCKTIME": "0",  # LLVM's and Intel's: milliseconds
}
if "OMP_WAIT_POLICY" not in os.environ:
    for _name, _value in WAITING.items():
        os.environ.setdefault(_name, _value)

import numba  # noqa: E402
from numba.core import event  # noqa: E402

from .jit_cache import KernelCache, Trouble, is_whole, pattern_of, stem_of  # noqa: E402

#: Is told the name of a kernel that is being compiled, and how many seconds that took.
Begun = Callable[[str], None]
Done = Callable[[float], None]

SMALL = 4096  # rows that one thread works through before another would have woken up

#: All that compiled code is made of: kernels, and the modules whose constants and functions they use.
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
    """Where compiled code is kept, or None where nothing can be written.

    numba looks at the file of a kernel alone to tell whether what it has is of the same source; a kernel also consists
    of those that it calls and of constants that it uses. So the folder's name is of all the source there is.
    """
    package = Path(__file__).parents[1]
    sources = [path for pattern in SOURCES for path in sorted(package.glob(pattern))]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [package / "__pycache__"]
    if not given:
        with contextlib.suppress(RuntimeError):  # nobody's home
            places.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sparklod")
    for place in places:
        folder = place / f"kernels-{digest}"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder
    return None


#: None: kernels are compiled in every process.
CACHE_FOLDER = _cache_folder()


def kernel(
    *, parallel: bool = False, nogil: bool = False, inline: bool = False, contract: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorator for a compiled function.

    No fastmath: results must not depend on the number of threads. The machine code is cached beside the source, or in
    the user's cache directory where the package is read-only; where neither can be written it is compiled every time.

    Args:
        parallel: has loops that run on the threads of `use_threads`.
        nogil: lets other threads of this process run meanwhile.
        contract: a product and a sum may be rounded once instead of twice, where the processor can.
        inline: becomes part of the kernels that call it; LLVM does not do that by itself with all that deserve it.
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
    """Whether this process finds compiled code of a kernel; its name is that of its module, a point, and its own."""
    if CACHE_FOLDER is None:
        return False
    with contextlib.suppress(OSError):
        return any(path.is_file() and is_whole(path.read_bytes()) for path in CACHE_FOLDER.glob(pattern_of(name)))
    return False


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


#: Who is told of what keeps the cache from working.
_troubled: list[Trouble] = []


def _tell_trouble(text: str) -> None:
    for tell in _troubled:
        tell(text)


class _OnCompile(event.Listener):
    """Tells of kernels that Python calls, not of those that they are made of."""

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
    """Listens to what happens when kernels are called for the first time.

    Args:
        begun: called with the name of each kernel that is compiled because no cache has it, see `is_cached`.
        done: called when it is compiled, with the seconds that took.
        trouble: called with a line on what keeps the cache from working.

    Returns:
        what ends that.
    """
    listener = _OnCompile(begun, done)
    event.register("numba:compile", listener)
    _troubled.append(trouble)

    def stop() -> None:
        event.unregister("numba:compile", listener)
        _troubled.remove(trouble)

    return stop


def threads_in_use() -> int:
    """How many threads kernels run on."""
    threads: int = numba.get_num_threads()
    return threads


def threading_layer() -> str:
    """What runs the loops of parallel kernels: omp, tbb or workqueue; starts their threads.

    Raises:
        ValueError: none of them loads.
    """
    from numba.np.ufunc.parallel import _launch_threads

    _launch_threads()
    layer: str = numba.threading_layer()
    return layer
