"""Compiles kernels; the only module that imports numba, loaded where machine code is not in the cache."""

from __future__ import annotations

import functools
import pickle
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import caching, cgutils, compiler, event, serialize
from numba.core.serialize import dumps
from numba.extending import intrinsic
from numba.np.ufunc import parallel

from . import jit, jit_cache, jit_threads
from .errors import out_of_memory
from .jit_cache import Trouble, start_of, stem_of
from .jit_lean import lean
from .jit_link import MachineCode

_lock = threading.RLock()

# numba calls this Python function while a kernel returns; if a signal handler raised an exception in it, such as
# `KeyboardInterrupt`, that would be lost or end in a `SystemError`. A second call for an object runs no Python code.
serialize._numba_unpickle = functools.cache(serialize._numba_unpickle)


class Compiler:
    """A kernel as numba has it.

    Args:
        kernel: the kernel.
        folder: folder of the cache; None to cache nothing.
        trouble: called with a one-line message if the cache cannot be used.

    Attributes:
        inner: numba's dispatcher for calls by other kernels; nothing of what it compiles can be called from Python.
    """

    def __init__(self, kernel: jit.Kernel, folder: Path | None, trouble: Trouble) -> None:
        self._function, self._options, self._folder, self._trouble = kernel.py_func, kernel.options, folder, trouble
        self.inner = self._dispatcher(jit_cache.INNER, no_cpython_wrapper=True)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """numba's dispatcher for calls from Python; compiles the kernel for the types of its arguments."""
        dispatcher = self._dispatcher(jit_cache.SUFFIX)
        dispatcher.add_overload = functools.partial(_add_overload, dispatcher)
        return dispatcher

    def compile(self, arguments: Sequence[Any]) -> Callable[..., Any]:
        """What to call with arguments of these types, by numba alone."""
        called: Callable[..., Any] = self.dispatcher.compile(tuple(map(numba.typeof, arguments)))
        return called

    def machine_code(self, arguments: Sequence[Any]) -> MachineCode | None:
        """The machine code for arguments of these types; None if `jit_link` cannot link it, as found now or earlier.

        Raises:
            Exception: anything that numba raises.
        """
        signature = tuple(map(numba.typeof, arguments))
        if self._folder is not None and self.dispatcher._cache.path(signature).is_file():
            return None
        dispatcher = self._dispatcher()
        with lean():
            dispatcher.compile(signature)
            return _machine_code(dispatcher.overloads[signature])

    def _dispatcher(self, suffix: str = "", **more: bool) -> Any:
        """One of numba's dispatchers, which caches what it compiles in files with a suffix, or nowhere."""
        options = self._options
        decorate: Any = numba.njit(
            error_model="numpy",
            parallel=options.parallel,
            nogil=options.nogil,
            inline="always" if options.inline else "never",
            fastmath={"contract"} if options.contract else False,
            **more,
        )
        dispatcher = decorate(_for_numba(self._function))
        if suffix and self._folder is not None:
            dispatcher._cache = KernelCache(self._function, self._folder, suffix, self._trouble)
        return dispatcher


def _add_overload(dispatcher: Any, compiled: Any) -> None:
    """Adds what was compiled, and gives the kernels in it, which may have been compiled lean, their environments."""
    type(dispatcher).add_overload(dispatcher, compiled)
    for environment in compiled._find_referenced_environments():
        compiled.library.codegen.set_env(environment.env_name, environment)


def compiler_of(kernel: jit.Kernel) -> Compiler:
    """The compiler of a kernel, and those of all kernels of its module."""
    with _lock:
        if kernel.compiler is None:
            kernel.compiler = Compiler(kernel, jit.CACHE_FOLDER, jit.report_trouble)
            _fill_namespace(kernel.py_func.__globals__)
        found: Compiler = kernel.compiler
        return found


#: Copies of modules' globals as numba has them, and the originals, by the identity of the original.
_namespaces: dict[int, tuple[dict[str, Any], dict[str, Any]]] = {}


def _for_numba(function: Callable[..., Any]) -> FunctionType:
    """A copy of a function whose globals and closure are what numba knows.

    Nothing is replaced in the modules themselves, since other threads may be calling their functions.
    """
    assert isinstance(function, FunctionType)
    namespace, _ = _namespaces.setdefault(id(function.__globals__), ({}, function.__globals__))
    cells = tuple(CellType(_known(cell.cell_contents)) for cell in function.__closure__ or ())
    copy = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__, cells)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _fill_namespace(original: dict[str, Any]) -> None:
    namespace, _ = _namespaces[id(original)]
    for name, value in list(original.items()):
        namespace[name] = _known(value)


def _lower_prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """`jit.prefetch` in machine code."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        row = context.make_array(signature.args[0])(context, builder, arguments[0])
        shape, strides = cgutils.unpack_tuple(builder, row.shape), cgutils.unpack_tuple(builder, row.strides)
        place = cgutils.get_item_pointer2(context, builder, row.data, shape, strides, "C", [arguments[1]])
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        read, all_levels, data = word(0), word(3), word(1)
        builder.call(fetch, [builder.bitcast(place, byte), read, all_levels, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


_prefetch: Any = intrinsic(_lower_prefetch)


def _known(value: Any) -> Any:
    """What numba knows a global as: its own `prange`, and dispatchers instead of kernels."""
    if value is jit.prange:
        return numba.prange
    if value is jit.prefetch:
        return _prefetch
    return compiler_of(value).inner if isinstance(value, jit.Kernel) else value


class KernelCache(caching._Cache):
    """The cache of what numba makes of one function, in place of numba's own.

    numba's cache trusts its files: an empty one ends in an `EOFError`, a flipped bit in an error of LLVM or a crash, a
    full disk in an `OSError`; and two processes that compile two signatures of one function at the same time can each
    take the other's file for its own. Besides, it looks at the file of a kernel only, not at the kernels and constants
    that it uses. Here each signature has its own file, named by all that its code depends on. A file is written
    atomically and begins with a checksum. If a file is damaged, the kernel is compiled again; if the folder cannot be
    used, the kernel is compiled but not stored.

    Args:
        function: the Python function.
        folder: folder of the files.
        suffix: of the files.
        trouble: called with a one-line message if the cache cannot be used.
    """

    def __init__(self, function: Callable[..., Any], folder: Path, suffix: str, trouble: Trouble) -> None:
        self._function, self._folder, self._suffix, self._trouble = function, folder, suffix, trouble
        self._enabled = True

    @property
    def cache_path(self) -> str:
        return str(self._folder)

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        for path in self._folder.glob(f"{stem_of(self._function)}-*{self._suffix}"):
            path.unlink(missing_ok=True)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Loads the compiled function; returns None if it has to be compiled."""
        target_context.refresh()
        path = self.path(signature)
        try:
            content = jit_cache.read(path) if self._enabled else None
            if content is None:
                return None
            return compiler.CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception as error:
            # An undamaged file may still be unusable, for example if it refers to types of another numpy.
            if out_of_memory(error):
                raise
        jit_cache.discard(path, self._trouble)
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Writes a compiled function to the cache, if it can be cached."""
        if self._enabled and not compiled.lifted and not compiled.library.has_dynamic_globals:
            jit_cache.write(self.path(signature), [dumps(compiled._reduce())], self._trouble)

    def path(self, signature: Any) -> Path:
        """The file for a signature."""
        return self._folder / f"{start_of(self._function)}-{jit_cache.digest(str(signature))}{self._suffix}"


def _machine_code(compiled: Any) -> MachineCode | None:
    """The machine code of a function that was compiled lean; None if it takes more than `jit_link` gives."""
    environment, description, library = compiled.environment, compiled.fndesc, compiled.library
    referenced = compiled._find_referenced_environments()
    environments = [environment, *(other for other in referenced if other.env_name != environment.env_name)]
    constants = [value for each in environments for value in each.consts]
    known = all(isinstance(value, np.dtype) and value.fields is None and value.isnative for value in constants)
    starts_threads = [reload.__name__ == "_reload_parfors" for reload in compiled.reload_init or ()]
    if library.has_dynamic_globals or compiled.objectmode or compiled.lifted or not known or not all(starts_threads):
        return None
    return MachineCode(
        name=description.qualname.rpartition(".")[2],
        wrapper=description.llvm_cpython_wrapper_name,
        environments=tuple((each.env_name, tuple(value.str for value in each.consts)) for each in environments),
        parallel=bool(starts_threads),
        code=library.machine_code(),
    )


class _OnCompile(event.Listener):
    """Reports the compilation of kernels called from Python, not of the kernels that those call."""

    def __init__(self) -> None:
        self._depth, self._since = 0, 0.0

    def on_start(self, event: event.Event) -> None:
        self._depth += 1  # numba compiles on one thread at a time
        if self._depth == 1:
            self._since = time.perf_counter()
            jit.report_begun(stem_of(event.data["dispatcher"].py_func))

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            jit.report_done(time.perf_counter() - self._since)


event.register("numba:compile", _OnCompile())


def threading_layer() -> jit_threads.Layer:
    """The threading layer that numba chooses; starts its threads.

    Raises:
        ValueError: no threading layer can be loaded.
    """
    parallel._launch_threads()
    name: str = numba.threading_layer()
    return jit_threads.Layer(name, sys.modules[f"numba.{jit_threads.LAYERS[name]}"], numba.config.NUMBA_NUM_THREADS)


def _keep_threads() -> None:
    """Has numba start its threads now if they run already, which sets their number anew, and puts the number back."""
    layer = jit_threads.started()
    if layer is not None:
        count = layer.in_use()
        parallel._launch_threads()
        layer.use(count)


_keep_threads()
