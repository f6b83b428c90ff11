"""How sparklod compiles: the one place that configures numba."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import event

SMALL = 4096  # rows that one thread works through before another would have woken up


def _cache_folder() -> Path | None:
    """Where compiled code is kept, or None where nothing can be written.

    numba looks at the file of a kernel alone to tell whether what it has is of the same source; a kernel also consists
    of those that it calls and of constants that it uses. So the folder's name is of all the source there is.
    """
    package = Path(__file__).parent
    named = ("approximations.py", "gaussian.py", "jit.py")
    sources = [*(package / name for name in named), *sorted(package.glob("*/kernels/*.py"))]
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
            theirs = numba.config.CACHE_DIR
            numba.config.CACHE_DIR = str(CACHE_FOLDER)
            try:
                compiled.enable_caching()
            finally:
                numba.config.CACHE_DIR = theirs
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


def on_first_compile(callback: Callable[[], None]) -> Callable[[], None]:
    """Calls back when a kernel is compiled because no cache has it, the first time only.

    Returns:
        what ends that.
    """
    listener = _OnCompile(callback)
    event.register("numba:compile", listener)
    return functools.partial(event.unregister, "numba:compile", listener)


def threads_in_use() -> int:
    """How many threads kernels run on."""
    threads: int = numba.get_num_threads()
    return threads
