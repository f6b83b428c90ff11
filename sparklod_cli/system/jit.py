"""Kernels: functions that numba compiles. numba is loaded when one is called, as that takes half a second."""

from __future__ import annotations

import functools
import os
import re
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import CellType, FunctionType, ModuleType
from typing import Any

import numpy as np

from .kernel_cache import KernelCache, Trouble, cache_folders
from .threads import MOST_THREADS, run_ranges

#: Called with the name of a kernel when its compilation begins, and with its duration in seconds when it ends.
Begun = Callable[[str], None]
Done = Callable[[float], None]

#: The folder for compiled code, None if none can be written; folders of compiled code that is only read; and messages
#: on folders that are not used.
CACHE_FOLDER, READ_FOLDERS, DISTRUSTED = cache_folders(Path(__file__), Path(__file__).with_name("jit_numba.py"))

#: Whether the environment asks numba to compile nothing.
DISABLED = bool(re.fullmatch("[+-]?0*[1-9][0-9]*", os.environ.get("NUMBA_DISABLE_JIT", "").strip()))

#: File of settings that numba reads in the current folder.
SETTINGS = Path(".numba_config.yaml")

#: The name under which a module's globals have a copy of themselves, as numba has them.
_NAMESPACE = "__globals_of_kernels__"

_lock = threading.RLock()


def prefetch(array: Any, index: int) -> None:
    """Ask the processor to fetch an element of a C-contiguous row of records; in Python, do nothing.

    For loops that read elements in an order that the processor cannot foresee: with some iterations' notice, their
    cache misses overlap. An index beyond the end is harmless.
    """


@dataclass(frozen=True)
class Type:
    """Declared type of an argument: `f4` is a number, `f4[:]` and `f4[:, :]` are C-contiguous arrays, only read.

    Attributes:
        dtype: numpy's.
        axes: number of axes of an array; 0 for a number.
    """

    dtype: np.dtype[Any]
    axes: int = 0

    def __getitem__(self, axes: slice | tuple[slice, ...]) -> Type:
        return replace(self, axes=len(axes) if isinstance(axes, tuple) else 1)


@dataclass(frozen=True)
class out:  # noqa: N801 - it stands in signatures, as f4 does
    """Declared type of an argument whose arrays a kernel writes to: `out(f4[:])`, or `out` of a NamedTuple."""

    declared: Any


b1, u1, u2, u4, u8 = (Type(np.dtype(code)) for code in ("?", "u1", "u2", "u4", "u8"))
i2, i4, i8, f4, f8 = (Type(np.dtype(code)) for code in ("i2", "i4", "i8", "f4", "f8"))


def fields(*types: Any) -> Callable[[Any], Any]:
    """Decorate a NamedTuple with the types of its fields, so that its name can stand in signatures."""

    def declare(kind: Any) -> Any:
        kind.kernel_types = types
        return kind

    return declare


def example(declared: Any, *, writeable: bool = False) -> Any:
    """Return an argument of a declared type, with empty arrays: what numba takes the types of a signature from."""
    if isinstance(declared, out):
        return example(declared.declared, writeable=True)
    if not isinstance(declared, Type):
        return declared(*(example(each, writeable=writeable) for each in declared.kernel_types))
    if not declared.axes:
        return declared.dtype.type(0)
    array = np.empty((0,) * declared.axes, declared.dtype)
    array.flags.writeable = writeable
    return array


def as_declared(declared: Any, argument: Any) -> Any:
    """Return an argument with arrays that are only read as read-only views, so that numba compiles for one type."""
    if isinstance(declared, out):
        return argument
    if not isinstance(declared, Type):
        if not isinstance(argument, declared):
            return argument
        return declared(*map(as_declared, declared.kernel_types, argument))
    if declared.axes and isinstance(argument, np.ndarray) and argument.flags.writeable:
        argument = argument.view(np.ndarray)
        argument.flags.writeable = False
    return argument


class Kernel:
    """A function that runs as machine code, which is compiled, or loaded from the cache, when it is first called.

    Attributes:
        py_func: the Python function.
        declared: the types that Python calls it with, for each signature, see `kernel`.
        ranges: Python calls it for ranges of rows, see `kernel`.
        options: keyword arguments of `numba.njit`.
        has_wrapper: numba's dispatcher that other kernels call also has the code that makes it callable from Python.
            That takes as long to compile as many a kernel, so kernels that Python does not call have none.
        inner, built: numba's dispatchers that kernels and Python call; None until they are needed.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        declared: Sequence[Sequence[Any]] = (),
        *,
        ranges: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self.declared, self.ranges, self.options = function, declared, ranges, options or {}
        self.has_wrapper = bool(declared) and not ranges
        self.inner: Any = None
        self.built: Any = None

    def __call__(self, *arguments: Any) -> Any:
        if self.declared:  # signatures differ in the types of numbers only
            types = self.declared[0]
            if len(arguments) != len(types):
                raise TypeError(f"{self.py_func.__name__} takes {len(types)} arguments but {len(arguments)} were given")
            arguments = tuple(map(as_declared, types, arguments))
        if self.ranges:
            return run_ranges(self.dispatcher, *arguments)
        return self.dispatcher(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    @property
    def dispatcher(self) -> Any:
        """Numba's function, which may be called with arguments of any types that it can be compiled for."""
        if self.built is None:
            numba = load_numba()
            with _lock:
                if self.built is None:
                    inner = self._inner_on(numba)
                    self.built = inner if self.has_wrapper else numba.calling(inner, self.py_func)
                    if self.declared:
                        self.built._cache = KernelCache(self.py_func, CACHE_FOLDER, READ_FOLDERS, report_trouble)
                        if before_first_call is not None:
                            before_first_call(self)
        return self.built

    def _inner_on(self, numba: ModuleType) -> Any:
        """Return the dispatcher of the module `jit_numba` that other kernels call.

        It compiles a copy of the function, in whose globals numba finds its own dispatchers. Nothing is replaced in the
        modules themselves, since other threads may be calling their functions.
        """
        if self.inner is None:
            function: Any = self.py_func
            namespace = function.__globals__.setdefault(_NAMESPACE, {})
            cells = tuple(CellType(_known(numba, cell.cell_contents)) for cell in function.__closure__ or ())
            copy = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__, cells)
            copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
            copy.__kwdefaults__ = function.__kwdefaults__
            self.inner = numba.compiled(copy, self.options, is_apart=self.ranges, has_wrapper=self.has_wrapper)
            if not self.declared:
                self.inner._cache = KernelCache(function, CACHE_FOLDER, READ_FOLDERS, report_trouble)
            for name, value in list(function.__globals__.items()):
                namespace[name] = _known(numba, value)
        return self.inner

    @functools.cached_property
    def signatures(self) -> list[tuple[Any, ...]]:
        """Numba's types of the arguments of each declared signature, as `dispatcher.compile` takes them."""
        load_numba()
        import numba

        first = (numba.int64,) if self.ranges else ()  # a range has two ends, its number of rows is declared
        return [(*first, *(numba.typeof(example(each)) for each in types)) for types in self.declared]


def _known(numba: ModuleType, value: Any) -> Any:
    """Return a global as numba uses it: a dispatcher instead of a kernel."""
    if value is prefetch:
        return numba.prefetch
    return value._inner_on(numba) if isinstance(value, Kernel) else value


def kernel(
    *types: Any,
    ranges: bool = False,
    nogil: bool = False,
    inline: bool = False,
    inline_late: bool = False,
    contract: bool = False,
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that is compiled.

    Without fastmath, because results must not depend on the number of threads. Machine code is cached in the
    package, or in the user's cache directory if the package is read-only; if neither is writable, every run compiles.

    A kernel that Python calls declares the types of its arguments, see `Type`: numbers `i8`, arrays `f4[:, :]`
    that it reads, arrays `out(f4[:])` that it writes to, and NamedTuples of them with `fields`. It is
    compiled for these, by `sparklod warmup` or when it is first called. Where it only reads, arrays may be read-only.

    Args:
        types: of the arguments; a tuple for each signature if there are several; nothing if only kernels call it.
        ranges: the first two arguments are the first row of a range and the one after its last. Python gives the number
            of rows instead, the first declared type, and the threads of `on_threads` run ranges of them. Ranges must
            not write to the same place, and what they write must not depend on how the rows are divided.
        nogil: releases the GIL, so that other Python threads can run.
        inline: numba copies the function into its callers before it infers types. For a few lines in innermost loops,
            which LLVM then vectorizes: the time to compile grows with the square of the lines that are copied.
        inline_late: LLVM copies the function into its callers, which it does not always do by itself. It is part of
            them, rather than a function apart that was optimized without knowing them.
        contract: allows fused multiply-add, which rounds once instead of twice, on processors that have it.
    """
    signatures = types if not types or isinstance(types[0], tuple) else (types,)
    if DISABLED:
        from .jit_python import interpreted

        return functools.partial(interpreted, ranges=ranges) if signatures else lambda function: function
    options = {
        "nogil": nogil or ranges,
        "inline": "always" if inline else "never",
        "forceinline": inline_late or ranges,
        "fastmath": {"contract"} if contract else False,
    }
    return functools.partial(Kernel, declared=signatures, ranges=ranges, options=options)


@functools.cache
def load_numba() -> ModuleType:
    """Import `jit_numba` and, with it, numba.

    A file of settings can name libraries, which numba loads. The current folder may be somebody else's: an unpacked
    archive, a shared folder.

    Raises:
        ImportError: numba is missing or broken.
        MemoryError: LLVM does not fit into memory.
        SparklodError: there is such a file, or a variable has a value that numba cannot use.
    """
    from .errors import SparklodError  # these here, so that no kernel depends on their sources
    from .python_process import safe_path

    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if "numba" in sys.modules:
        pass  # it has read its settings
    elif os.path.lexists(SETTINGS):
        raise SparklodError(
            f"{SETTINGS} in the current folder can have numba load other programs' code; remove it, or work in another"
            " folder; NUMBA_ variables of the environment have the same effect"
        )
    elif not threads.strip():  # such as $SLURM_CPUS_PER_TASK outside of a job
        del os.environ["NUMBA_NUM_THREADS"]
    elif not (threads.isdecimal() and 1 <= int(threads) <= MOST_THREADS):
        raise SparklodError(
            f"NUMBA_NUM_THREADS is {threads[:40]!r}; set it to a whole number from 1 to {MOST_THREADS:,}, or unset it"
        )
    try:
        # Where processes are not forked, numba starts one when it is imported.
        with safe_path(), warnings.catch_warnings(record=True) as caught:
            from . import jit_numba
    except Exception as error:
        reasons = f"{error} {error.__cause__} {error.__context__}"  # llvmlite: its library is not there
        is_memory = "failed to map segment" in reasons or "annot allocate memory" in reasons
        if is_memory and not isinstance(error, ImportError):  # which has a message of its own
            raise MemoryError from error
        raise
    jit_numba.compilations.listeners = listeners
    for warning in caught:
        if warning.category is RuntimeWarning:  # of a variable; a traceback follows
            report_trouble(" ".join(str(warning.message).partition("\n")[0].split()))
    for text in DISTRUSTED:
        report_trouble(text)
    return jit_numba


#: Called with each kernel that Python calls for the first time, before it is loaded or compiled, so that no other
#: process compiles it, too; None for nothing.
before_first_call: Callable[[Kernel], None] | None = None

#: Functions that receive the reports on the compilation and the cache, see their types.
listeners: list[tuple[Begun, Done, Trouble]] = []


def report_trouble(text: str) -> None:
    """Report a problem of the cache to the listeners."""
    for _, _, trouble in listeners:
        trouble(text)
