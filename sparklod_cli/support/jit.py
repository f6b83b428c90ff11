"""Kernels: functions that numba compiles, and the threads that they run on. numba is loaded when one is called."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from .jit_types import as_declared, example
from .kernel_cache import SETTINGS, Trouble, cache_folder

#: How long OpenMP's threads spin while they wait for one another at the end of a parallel loop. By default they
#: spin for milliseconds, which on a busy machine takes the processor from the thread they wait for: four concurrent
#: bakes then take 1.5 times as long as four in sequence (benchmarks/notes/kernels.md). The variables are read
#: when the threads start; variables that are already set are left unchanged.
WAIT_SETTINGS = {
    "GOMP_SPINCOUNT": "1000",  # GNU: iterations, about 20 microseconds
    "KMP_BLOCKTIME": "0",  # LLVM and Intel: milliseconds
}
if "OMP_WAIT_POLICY" not in os.environ:
    for _name, _value in WAIT_SETTINGS.items():
        os.environ.setdefault(_name, _value)

#: Called with the name of a kernel when its compilation begins, and with its duration in seconds when it ends.
Begun = Callable[[str], None]
Done = Callable[[float], None]

#: Least number of rows for which several threads are used: with fewer, one thread finishes before another wakes up.
#: Chosen; no difference was measured up to 65,536 (benchmarks/notes/kernels.md).
PARALLEL_ROWS = 4096

#: The folder for compiled code; None if kernels have to be compiled in every process.
CACHE_FOLDER = cache_folder(Path(__file__))


class prange:  # noqa: N801 - it is numba's, and Python's `range` where kernels are not compiled
    """A range whose iterations run on several threads in a compiled kernel that is `parallel`."""

    def __new__(cls, *bounds: int) -> range:  # type: ignore[misc]
        return range(*bounds)


def prefetch(array: Any, index: int) -> None:
    """Ask the processor to fetch an element of a C-contiguous row of records; in Python, do nothing.

    For loops that read elements in an order that the processor cannot foresee: with some iterations' notice, their
    cache misses overlap. An index beyond the end is harmless.
    """


@dataclass(frozen=True)
class Options:
    """Compilation options of a kernel; see `kernel`."""

    parallel: bool
    nogil: bool
    inline: bool
    contract: bool


class Kernel:
    """A function that runs as machine code, which is compiled, or loaded from the cache, when it is first called.

    Args:
        function: the Python function.
        options: how to compile it.
        declared: the types that Python calls it with, for each signature, see `kernel`.

    Attributes:
        py_func: the Python function.
        options: how to compile it.
        declared: the types that Python calls it with.
        built: see `jit_numba.dispatcher_of`; None until it is needed.
    """

    def __init__(self, function: Callable[..., Any], options: Options, declared: Sequence[Sequence[Any]] = ()) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self.options, self.declared = function, options, declared
        self.built: Any = None

    def __call__(self, *arguments: Any) -> Any:
        if self.declared:  # signatures differ in the types of numbers only
            arguments = tuple(map(as_declared, self.declared[0], arguments))
        if self.options.parallel:
            with _one_at_a_time():
                return self.dispatcher(*arguments)
        return self.dispatcher(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    @property
    def dispatcher(self) -> Any:
        """Numba's function, which may be called with arguments of any types that it can be compiled for."""
        return self.built or load_numba().dispatcher_of(self)

    @functools.cached_property
    def signatures(self) -> list[tuple[Any, ...]]:
        """Numba's types of the arguments of each declared signature."""
        import numba

        return [tuple(numba.typeof(example(each)) for each in types) for types in self.declared]


def kernel(
    *types: Any, parallel: bool = False, nogil: bool = False, inline: bool = False, contract: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that is compiled.

    Without fastmath, because results must not depend on the number of threads. Machine code is cached in the
    package, or in the user's cache directory if the package is read-only; if neither is writable, every run compiles.

    A kernel that Python calls declares the types of its arguments, see `jit_types`: numbers `i8`, arrays `f4[:, :]`
    that it reads, arrays `out(f4[:])` that it writes to, and NamedTuples of them with `jit_types.fields`. It is
    compiled for these, by `sparklod warmup` or when it is first called. Where it only reads, arrays may be read-only.

    Args:
        types: of the arguments; a tuple for each signature if there are several; nothing if only kernels call it.
        parallel: the function has loops that run on the threads of `use_threads`.
        nogil: releases the GIL, so that other Python threads can run.
        inline: always inlines the function into its callers, which LLVM does not always do by itself.
        contract: allows fused multiply-add, which rounds once instead of twice, on processors that have it.
    """
    options = Options(parallel, nogil, inline, contract)
    signatures = types if not types or isinstance(types[0], tuple) else (types,)

    def decorate(function: Callable[..., Any]) -> Any:
        return function if _is_disabled() else Kernel(function, options, signatures)

    return decorate


def _is_disabled() -> bool:
    """Return True if the environment asks numba to compile nothing."""
    try:
        return bool(int(os.environ.get("NUMBA_DISABLE_JIT") or 0))
    except ValueError:
        return False


def load_numba() -> ModuleType:
    """Import `jit_numba` and, with it, numba.

    Raises:
        ImportError: numba is missing or broken.
        MemoryError: LLVM does not fit into memory.
        SparklodError: numba's settings in the current folder are malformed.
    """
    try:
        from . import jit_numba
    except ImportError:
        raise
    except Exception as error:  # of the parser, or of numba where values are of no type that it knows
        reasons = f"{error} {error.__cause__} {error.__context__}"  # llvmlite: its library is not there
        if "failed to map segment" in reasons or "annot allocate memory" in reasons:
            raise MemoryError from error
        if not SETTINGS.exists():
            raise
        from .errors import SparklodError  # here, so that no kernel depends on its source

        raise SparklodError(
            f"{SETTINGS} in the current folder, which numba reads, is malformed"
            f" ({' '.join(str(error).split())}); correct it, remove it, or work in another folder"
        ) from None
    return jit_numba


# Threads

#: Held while a parallel kernel runs on a layer that is not thread-safe. Reentrant, because a signal handler or a
#: finaliser can call a kernel in the thread that holds it.
_running = threading.RLock()

#: True in a process that was forked from one that had started threads: it has one thread.
_has_one_thread = False


def use_threads(count: int) -> None:
    """Run kernels that this thread calls on `count` threads, or on all if there are fewer.

    Raises:
        ValueError: `count` is less than 1.
    """
    load_numba()
    import numba

    if count < 1:
        raise ValueError(f"kernels cannot run on {count} threads")
    numba.set_num_threads(min(count, 1 if _has_one_thread else numba.config.NUMBA_NUM_THREADS))


def threads_in_use() -> int:
    """Return the number of threads that kernels called by this thread run on."""
    load_numba()
    import numba

    return int(numba.get_num_threads())


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Run kernels inside on one thread if there are fewer than PARALLEL_ROWS rows; yield the number of threads.

    Waking the other threads takes longer than processing a few thousand rows; on a busy machine, where the threads
    sleep, a thousand times longer.
    """
    threads = threads_in_use()
    use_threads(1 if rows < PARALLEL_ROWS else threads)
    try:
        yield threads_in_use()
    finally:
        use_threads(threads)


@functools.cache
def threading_layer() -> str:
    """Start the threads, and return the layer that runs parallel loops: omp, tbb or workqueue.

    Raises:
        ValueError: no threading layer can be loaded.
    """
    threads_in_use()
    import numba

    return str(numba.threading_layer())


def _one_at_a_time() -> contextlib.AbstractContextManager[Any]:
    """Return a context for a call of a parallel kernel, in which others wait where the layer is not thread-safe.

    numba's own layer, workqueue, which is used where neither TBB nor OpenMP is installed, aborts the process if two
    threads run parallel loops at the same time.
    """
    return _running if threading_layer() == "workqueue" else contextlib.nullcontext()


def _after_fork() -> None:
    global _running, _has_one_thread
    _running = threading.RLock()  # another thread of the parent may hold the lock
    if f"{__package__}.jit_numba" in sys.modules:
        _has_one_thread = load_numba().restart_on_one_thread()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


# Who is told of compilations, and of a cache that does not work

_listeners: list[tuple[Begun, Done, Trouble]] = []


def report_begun(name: str) -> None:
    """Report to listeners which kernel is being compiled."""
    for begun, _, _ in _listeners:
        begun(name)


def report_done(seconds: float) -> None:
    """Report to listeners how long that took."""
    for _, done, _ in _listeners:
        done(seconds)


def report_trouble(text: str) -> None:
    """Report to listeners what is wrong with the cache."""
    for _, _, trouble in _listeners:
        trouble(text)


def listen(begun: Begun, done: Done, trouble: Trouble) -> Callable[[], None]:
    """Report what happens when kernels are called for the first time.

    Args:
        begun: called with the name of each kernel that has to be compiled because it is not in the cache.
        done: called with the duration of the compilation in seconds.
        trouble: called with a one-line message if the cache cannot be used.

    Returns:
        a function that stops the reports.
    """
    listener = begun, done, trouble
    _listeners.append(listener)
    return lambda: _listeners.remove(listener)
