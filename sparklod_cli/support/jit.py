"""Kernels: functions that are compiled, and run as machine code. numba, which compiles, is loaded only to compile."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

#: How long OpenMP's threads spin while they wait for one another at the end of a parallel loop. By default they
#: spin for milliseconds, which on a busy machine takes the processor from the thread they wait for: four concurrent
#: bakes then take 1.5 times as long as four in sequence (docs/decisions/2026-11-21-kernels.md). The variables are read
#: when the threads start; variables that are already set are left unchanged.
WAIT_SETTINGS = {
    "GOMP_SPINCOUNT": "1000",  # GNU: iterations, about 20 microseconds
    "KMP_BLOCKTIME": "0",  # LLVM and Intel: milliseconds
}
if "OMP_WAIT_POLICY" not in os.environ:
    for _name, _value in WAIT_SETTINGS.items():
        os.environ.setdefault(_name, _value)

from . import jit_cache, jit_link, jit_threads  # noqa: E402
from .errors import SparklodError, out_of_memory  # noqa: E402
from .jit_cache import CODE, SUFFIX, Trouble, is_whole, start_of  # noqa: E402
from .jit_types import describe, example, fits, key_of  # noqa: E402
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
    here = Path(__file__)
    digest = digest_of(sources_of(here) | sources_of(here.with_name("jit_numba.py")))
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


class prange:  # noqa: N801 - it is numba's, and Python's `range` where kernels are not compiled
    """A range whose iterations run on several threads in a compiled kernel that is `parallel`."""

    def __new__(cls, *bounds: int) -> range:  # type: ignore[misc]
        return range(*bounds)


def prefetch(array: Any, index: int) -> None:
    """In a compiled kernel: asks the processor to fetch an element of a C-contiguous row of records; changes nothing.

    For loops that read elements in an order that the processor cannot foresee: with some iterations' notice, their
    cache misses overlap. An index beyond the end is harmless.
    """


@dataclass(frozen=True)
class Options:
    """How a kernel is compiled; see `kernel`."""

    parallel: bool
    nogil: bool
    inline: bool
    contract: bool


class Kernel:
    """A function that runs as machine code, one for each combination of types of its arguments.

    Machine code comes from the cache, or from numba where the cache has none.

    Args:
        function: the Python function.
        options: how to compile it.
        signatures: the types that Python calls it with, see `kernel`.

    Attributes:
        py_func: the Python function.
        options: how to compile it.
        signatures: the types that Python calls it with.
        compiler: see `jit_numba.compiler_of`; None as long as nothing had to be compiled.
        called: what runs with arguments of the types of a key, see `jit_types.key_of`.
    """

    def __init__(
        self, function: Callable[..., Any], options: Options, signatures: Sequence[Sequence[Any]] = ()
    ) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self.options, self.signatures = function, options, signatures
        self.compiler: Any = None
        self.called: dict[Hashable, Callable[..., Any]] = {}
        self._called: dict[str, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if named or self.py_func.__defaults__:
            bound = inspect.signature(self.py_func).bind(*arguments, **named)
            bound.apply_defaults()
            arguments = bound.args
        key = key_of(arguments)
        called = self.called.get(key)
        if called is None:
            called = self._find(key, arguments)
        return called(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    @functools.cached_property
    def examples(self) -> dict[str, tuple[Any, ...]]:
        """Arguments of each declared signature, by their description."""
        every = [tuple(map(example, types)) for types in self.signatures]
        return {str(describe(arguments)): arguments for arguments in every}

    def declared(self, arguments: tuple[Any, ...]) -> str | None:
        """Return the description of the declared signature that arguments fit; None if there is none."""
        text = describe(arguments)
        return next((declared for declared in self.examples if text is not None and fits(text, declared)), None)

    def _find(self, key: Hashable | None, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        """What to call with arguments of these types."""
        text = None if key is None else self.declared(arguments) or describe(arguments)
        if text is None:
            return self._guarded(self._dispatcher())
        called = self._called.get(text)
        if called is None:
            called = self._called[text] = self._guarded(self.prepare(text, arguments))
        self.called[key] = called
        return called

    def _guarded(self, called: Callable[..., Any]) -> Callable[..., Any]:
        return jit_threads.guarded(called) if self.options.parallel else called

    def prepare(self, text: str, arguments: tuple[Any, ...] = ()) -> Callable[..., Any]:
        """Load machine code, or compile it if the cache has none.

        Args:
            text: types, as `jit_types.describe` has them.
            arguments: of these types; unnecessary where the kernel declares them.
        """
        path = self._path(text)
        called = None if path is None else self._load(path)
        return self._compile(path, self.examples.get(text, arguments)) if called is None else called

    def is_cached(self, text: str) -> bool:
        """Return True if this process can load machine code for types that `jit_types.describe` describes as `text`."""
        if CACHE_FOLDER is None:
            return False
        path = self._path(text)
        # Where machine code is not linked, numba names the file.
        files = [*([] if path is None else [path]), *CACHE_FOLDER.glob(f"{start_of(self.py_func)}-*{SUFFIX}")]
        with contextlib.suppress(OSError):
            return any(file.is_file() and is_whole(file.read_bytes()) for file in files)
        return False

    def _path(self, text: str) -> Path | None:
        """The file of machine code for types; None if there cannot be one."""
        if CACHE_FOLDER is None or not jit_link.is_tested():
            return None
        return CACHE_FOLDER / f"{start_of(self.py_func)}-{jit_cache.digest(text)}{CODE}"

    def _dispatcher(self) -> Callable[..., Any]:
        """What numba calls with arguments of any types, or refuses them with."""
        dispatcher: Callable[..., Any] = load_compiler().compiler_of(self).dispatcher
        return dispatcher

    def _load(self, path: Path) -> Callable[..., Any] | None:
        """Loads machine code from a file; None if there is none, or none that can be used."""
        try:
            content = jit_cache.read(path)
            return None if content is None else jit_link.link(jit_link.MachineCode.from_bytes(content), self.py_func)
        except Exception as error:
            if out_of_memory(error):
                raise
        jit_cache.discard(path, report_trouble)
        return None

    def _compile(self, path: Path | None, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        """Compiles the kernel, and writes the machine code to a file if it can be linked, as it is in this process."""
        compiler = load_compiler().compiler_of(self)
        if jit_link.is_tested():
            try:
                code = compiler.machine_code(arguments)
                linked = None if code is None else jit_link.link(code, self.py_func)
            except Exception as error:
                if out_of_memory(error):
                    raise
            else:
                if path is not None and code is not None:
                    jit_cache.write(path, code.pieces(), report_trouble)
                if linked is not None:
                    return linked
        called: Callable[..., Any] = compiler.compile(arguments)
        return called


def kernel(
    *types: Any, parallel: bool = False, nogil: bool = False, inline: bool = False, contract: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorator for a compiled function.

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
    """Whether the environment asks numba to compile nothing."""
    try:
        return bool(int(os.environ.get("NUMBA_DISABLE_JIT") or 0))
    except ValueError:
        return False


def use_threads(count: int) -> None:
    """Runs kernels that this thread calls on `count` threads, or on all if there are fewer."""
    jit_threads.layer().use(count)


def threads_in_use() -> int:
    """The number of threads that kernels called by this thread run on."""
    return jit_threads.layer().in_use()


@contextlib.contextmanager
def threads_for(rows: int) -> Iterator[int]:
    """Runs kernels inside on one thread if there are fewer than PARALLEL_ROWS rows; yields the number of threads.

    Waking the other threads takes longer than processing a few thousand rows; on a busy machine, where the threads
    sleep, a thousand times longer.
    """
    threads = threads_in_use()
    use_threads(1 if rows < PARALLEL_ROWS else threads)
    try:
        yield threads_in_use()
    finally:
        use_threads(threads)


def threading_layer() -> str:
    """The layer that runs parallel loops: omp, tbb or workqueue. Starts its threads.

    Raises:
        ValueError: no threading layer can be loaded.
    """
    return jit_threads.layer().name


def load_compiler() -> ModuleType:
    """Import `jit_numba` and, with it, numba, which otherwise happens when something has to be compiled.

    Raises:
        ImportError: numba is missing or broken.
        SparklodError: its settings in the current folder are malformed.
    """
    try:
        from . import jit_numba
    except ImportError:
        raise
    except Exception as error:  # of the parser, or of numba where values are of no type that it knows
        if not jit_cache.SETTINGS.exists():
            raise
        raise SparklodError(
            f"{jit_cache.SETTINGS} in the current folder, which numba reads, is malformed"
            f" ({' '.join(str(error).split())}); correct it, remove it, or work in another folder"
        ) from None
    return jit_numba


#: Who is told of compilations and of a cache that does not work, see `listen`.
_listeners: list[tuple[Begun, Done, Trouble]] = []


def report_begun(name: str) -> None:
    """Tells listeners which kernel is being compiled."""
    for begun, _, _ in _listeners:
        begun(name)


def report_done(seconds: float) -> None:
    """Tells listeners how long that took."""
    for _, done, _ in _listeners:
        done(seconds)


def report_trouble(text: str) -> None:
    """Tells listeners what is wrong with the cache."""
    for _, _, trouble in _listeners:
        trouble(text)


def listen(begun: Begun, done: Done, trouble: Trouble) -> Callable[[], None]:
    """Reports what happens when kernels are called for the first time.

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
