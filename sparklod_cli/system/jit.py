"""Kernels: functions that run as machine code, which numba compiles where none is kept."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import operator
import os
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import CellType, FunctionType, ModuleType
from typing import Any

import numpy as np

from . import machine_code
from .machine_code import Trouble, stem_of
from .threads import given_threads, run_ranges

#: Called with the name of a kernel when its compilation begins, and with its duration in seconds when it ends.
Begun = Callable[[str], None]
Done = Callable[[float], None]

#: The folder for compiled code, None if none can be written; folders of compiled code that is only read; and messages
#: on folders that are not used.
CACHE_FOLDER, READ_FOLDERS, DISTRUSTED = machine_code.cache_folders()

#: Whether the environment asks numba to compile nothing.
DISABLED = bool(re.fullmatch("[+-]?0*[1-9][0-9]*", os.environ.get("NUMBA_DISABLE_JIT", "").strip()))

#: File of settings that numba reads in the current folder.
SETTINGS = Path(".numba_config.yaml")

#: The name under which a module's globals have a copy of themselves, as numba has them.
_NAMESPACE = "__globals_of_kernels__"

_lock = threading.RLock()


# --- Types ------------------------------------------------------------------------------------------------------------


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

    def __str__(self) -> str:
        return f"{self.dtype}[{', '.join(':' * self.axes)}]" if self.axes else str(self.dtype)


@dataclass(frozen=True)
class out:  # noqa: N801 - it stands in signatures, as f4 does
    """Declared type of an argument whose arrays a kernel writes to: `out(f4[:])`, or `out` of a NamedTuple."""

    declared: Any


b1, u1, u2, u4, u8 = (Type(np.dtype(code)) for code in ("?", "u1", "u2", "u4", "u8"))
i2, i4, i8, f4, f8 = (Type(np.dtype(code)) for code in ("i2", "i4", "i8", "f4", "f8"))

#: Types of C and conversions from Python, by numpy's code of the type of a number.
_NUMBERS: Mapping[str, tuple[Any, Callable[[Any], Any]]] = {
    "?": (ctypes.c_uint8, bool),
    **{
        code: (getattr(ctypes, f"c_{'u' * (code[0] == 'u')}int{int(code[1]) * 8}"), operator.index)
        for code in ("u1", "u2", "u4", "u8", "i2", "i4", "i8")
    },
    "f4": (ctypes.c_float, float),
    "f8": (ctypes.c_double, float),
}


def _code(number: Type) -> str:
    return "?" if number.dtype.kind == "b" else number.dtype.str[1:]


def fields(*types: Any) -> Callable[[Any], Any]:
    """Decorate a NamedTuple with the types of its fields, so that its name can stand in signatures."""

    def declare(kind: Any) -> Any:
        kind.kernel_types = types
        return kind

    return declare


def parameters_of(declared: Any) -> list[Any]:
    """Return the types of C of an argument's parameters, see `compiler.object_file`."""
    if isinstance(declared, out):
        return parameters_of(declared.declared)
    if not isinstance(declared, Type):
        return [kind for each in declared.kernel_types for kind in parameters_of(each)]
    return [ctypes.c_void_p, *[ctypes.c_int64] * declared.axes] if declared.axes else [_NUMBERS[_code(declared)][0]]


def add_values(declared: Any, argument: Any, values: list[Any], *, is_out: bool = False) -> None:
    """Append an argument's values for its `parameters_of`; raise `TypeError` if it is not of the declared type."""
    if isinstance(declared, out):
        add_values(declared.declared, argument, values, is_out=True)
    elif not isinstance(declared, Type):
        for each, field in zip(declared.kernel_types, argument, strict=True):
            add_values(each, field, values, is_out=is_out)
    elif not declared.axes:
        values.append(_NUMBERS[_code(declared)][1](argument))
    elif not (
        isinstance(argument, np.ndarray)
        and argument.dtype == declared.dtype
        and argument.ndim == declared.axes
        and argument.flags.c_contiguous
        and argument.flags.aligned
    ):
        shown = f"{argument.dtype} {argument.shape}" if isinstance(argument, np.ndarray) else type(argument).__name__
        raise TypeError(f"a kernel takes a C-contiguous {declared}, not {shown}")
    elif is_out and not argument.flags.writeable:
        raise TypeError("a kernel writes to an array that is read-only")
    else:
        values.append(argument.__array_interface__["data"][0])
        values.extend(argument.shape)


# --- Kernels ----------------------------------------------------------------------------------------------------------


def prefetch(array: Any, index: int) -> None:
    """Ask the processor to fetch an element of a C-contiguous row of records; in Python, do nothing.

    For loops that read elements in an order that the processor cannot foresee: with some iterations' notice, their
    cache misses overlap. An index beyond the end is harmless.
    """


class Kernel:
    """A function that runs as machine code, which is loaded, or else compiled, when it is first called.

    Attributes:
        py_func: the Python function.
        declared: the types that Python calls it with, for each signature, see `kernel`.
        returns: the types of the numbers that it returns to Python.
        ranges: Python calls it for ranges of rows, see `kernel`.
        options: keyword arguments of `numba.njit`.
        inner: numba's dispatcher, which other kernels call; None until it is needed.
        codes: loaded C functions by the number of their signature.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        declared: Sequence[Sequence[Any]] = (),
        *,
        returns: Sequence[Type] = (),
        ranges: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self.declared, self.returns = function, declared, returns
        self.ranges, self.options = ranges, options or {}
        self.inner: Any = None
        self.codes: dict[int, Any] = {}

    def __call__(self, *arguments: Any) -> Any:
        number, values = self._values(arguments)
        code = self.codes.get(number) or self.load(number)
        if self.ranges:
            run_ranges(code, *values)
            return None
        results = [_NUMBERS[_code(each)][0]() for each in self.returns]
        code(*values, *map(ctypes.addressof, results))
        found = tuple(result.value for result in results)
        return found if len(found) > 1 else found[0] if found else None

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    def _values(self, arguments: Sequence[Any]) -> tuple[int, list[Any]]:
        """Return the number of the first signature that takes arguments, and their values as parameters of C."""
        error = TypeError(f"{self.py_func.__name__} can be called by kernels only")
        for number, types in enumerate(self.declared):
            if len(arguments) != len(types):
                raise TypeError(f"{self.py_func.__name__} takes {len(types)} arguments but {len(arguments)} were given")
            values = list[Any]()
            try:
                for declared, argument in zip(types, arguments, strict=True):
                    add_values(declared, argument, values)
            except TypeError as mismatch:
                error = mismatch
            else:
                return number, values
        raise error

    def load(self, number: int = 0) -> Any:
        """Return the function of C for a signature, which is compiled if no machine code of it is kept."""
        with _lock:
            if number not in self.codes:
                if before_first_call is not None:
                    before_first_call(self)
                name = machine_code.name_of(self.py_func, number)
                address = machine_code.shipped(name)
                if address is None:
                    address = machine_code.load(name, self.kept(number) or self.compile(number))
                types = [kind for each in self.declared[number] for kind in parameters_of(each)]
                start = [ctypes.c_int64] if self.ranges else []
                code = ctypes.CFUNCTYPE(ctypes.c_int64, *start, *types, *[ctypes.c_void_p] * len(self.returns))(address)
                code.errcheck = _check_status  # type: ignore[assignment]
                self.codes[number] = code
        return self.codes[number]

    def kept(self, number: int) -> bytes | None:
        """Read the object file for a signature; None if no folder has it."""
        name = machine_code.name_of(self.py_func, number)
        return machine_code.read(name, [*filter(None, [CACHE_FOLDER]), *READ_FOLDERS], report_trouble)

    def is_kept(self, number: int) -> bool:
        """Return whether there is machine code for a signature, which no run has to compile."""
        name = machine_code.name_of(self.py_func, number)
        return machine_code.shipped(name) is not None or self.kept(number) is not None

    def compile(self, number: int) -> bytes:
        """Compile the kernel for a signature, keep the object file, and return it."""
        compiler = load_compiler()
        for begun, _, _ in listeners:
            begun(stem_of(self.py_func))
        start = time.perf_counter()
        name = machine_code.name_of(self.py_func, number)
        content: bytes = compiler.object_file(
            self.inner_on(compiler), self.declared[number], self.returns, ranges=self.ranges, symbol=name
        )
        for _, done, _ in listeners:
            done(time.perf_counter() - start)
        if CACHE_FOLDER is not None:
            machine_code.write(name, content, CACHE_FOLDER, report_trouble)
        return content

    def inner_on(self, compiler: ModuleType) -> Any:
        """Return numba's dispatcher, which other kernels call.

        It compiles a copy of the function, in whose globals numba finds its own dispatchers. Nothing is replaced in the
        modules themselves, since other threads may be calling their functions.
        """
        if self.inner is None:
            function: Any = self.py_func
            namespace = function.__globals__.setdefault(_NAMESPACE, {})
            cells = tuple(CellType(_known(compiler, cell.cell_contents)) for cell in function.__closure__ or ())
            copy = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__, cells)
            copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
            copy.__kwdefaults__ = function.__kwdefaults__
            self.inner = compiler.decorated(copy, self.options, is_apart=self.ranges)
            for name, value in list(function.__globals__.items()):
                namespace[name] = _known(compiler, value)
        return self.inner


def _check_status(status: int, function: object, arguments: object) -> int:
    """Raise an exception for the status that machine code returned; see `compiler.RUNTIME`."""
    if status == 1:
        raise MemoryError
    if status:
        raise RuntimeError("a kernel failed; please report this")
    return status


def _known(compiler: ModuleType, value: Any) -> Any:
    """Return a global as numba uses it: a dispatcher instead of a kernel."""
    if value is prefetch:
        return compiler.prefetch
    return value.inner_on(compiler) if isinstance(value, Kernel) else value


def kernel(
    *types: Any,
    returns: Type | tuple[Type, ...] = (),
    ranges: bool = False,
    inline: bool = False,
    inline_late: bool = False,
    contract: bool = False,
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that is compiled.

    Without fastmath, because results must not depend on the number of threads. Machine code comes with the package, or
    is cached in it or, if it is read-only, in the user's cache directory. If neither is writable, every run compiles.
    It runs without the GIL.

    A kernel that Python calls declares the types of its arguments, see `Type`: numbers `i8`, arrays `f4[:, :]`
    that it reads, arrays `out(f4[:])` that it writes to, and NamedTuples of them with `fields`. Arguments must have
    these types; where it only reads, arrays may be read-only. It may return numbers, not arrays.

    Args:
        types: of the arguments; a tuple for each signature if there are several; nothing if only kernels call it.
        returns: types of the numbers that it returns to Python.
        ranges: the first two arguments are the first row of a range and the one after its last. Python gives the number
            of rows instead, the first declared type, and the threads of `on_threads` run ranges of them. Ranges must
            not write to the same place, and what they write must not depend on how the rows are divided.
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
        "inline": "always" if inline else "never",
        "forceinline": inline_late or ranges,
        "fastmath": {"contract"} if contract else False,
    }
    several = returns if isinstance(returns, tuple) else (returns,)
    return functools.partial(Kernel, declared=signatures, returns=several, ranges=ranges, options=options)


# --- The compiler -----------------------------------------------------------------------------------------------------


@functools.cache
def load_compiler() -> ModuleType:
    """Import `compiler` and, with it, numba.

    A file of settings can name libraries, which numba loads. The current folder may be somebody else's: an unpacked
    archive, a shared folder.

    Raises:
        ImportError: numba is missing or broken.
        MemoryError: LLVM does not fit into memory.
        SparklodError: there is such a file, or a variable has a value that numba cannot use.
    """
    from .errors import SparklodError
    from .python_process import safe_path

    given_threads()
    if "numba" not in sys.modules and os.path.lexists(SETTINGS):  # else it has read its settings
        raise SparklodError(
            f"{SETTINGS} in the current folder can have numba load other programs' code; remove it, or work in another"
            " folder; NUMBA_ variables of the environment have the same effect"
        )
    try:
        # Where processes are not forked, numba starts one when it is imported.
        with safe_path(), _variables(), warnings.catch_warnings(record=True) as caught:
            from . import compiler
    except Exception as error:
        reasons = f"{error} {error.__cause__} {error.__context__}"  # llvmlite: its library is not there
        is_memory = "failed to map segment" in reasons or "annot allocate memory" in reasons
        if is_memory and not isinstance(error, ImportError):  # which has a message of its own
            raise MemoryError from error
        raise
    for warning in caught:
        if warning.category is RuntimeWarning:  # of a variable; a traceback follows
            report_trouble(" ".join(str(warning.message).partition("\n")[0].split()))
    for text in DISTRUSTED:
        report_trouble(text)
    return compiler


@contextlib.contextmanager
def _variables() -> Iterator[None]:
    """Have numba read the kind of processor to compile for, and no empty number of threads, from the environment."""
    changed = {"NUMBA_CPU_NAME": machine_code.level(), "NUMBA_CPU_FEATURES": ""}
    before = {name: os.environ.get(name) for name in (*changed, "NUMBA_NUM_THREADS")}
    os.environ.update(changed)
    if not (before["NUMBA_NUM_THREADS"] or "").strip():  # such as $SLURM_CPUS_PER_TASK outside of a job
        os.environ.pop("NUMBA_NUM_THREADS", None)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


#: Called with each kernel that Python calls for the first time, before it is loaded or compiled, so that no other
#: process compiles it, too; None for nothing.
before_first_call: Callable[[Kernel], None] | None = None

#: Functions that receive the reports on the compilation and the cache, see their types.
listeners: list[tuple[Begun, Done, Trouble]] = []


def report_trouble(text: str) -> None:
    """Report a problem of the cache to the listeners."""
    for _, _, trouble in listeners:
        trouble(text)
