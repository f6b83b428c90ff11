"""Kernels as numba has them; loaded when one is called for the first time, because numba takes half a second to load.

Of what numba does not document, this and `kernel_cache` use the cache of a dispatcher (`_cache`), what makes bytes of a
compiled function and back (`_reduce`, `_rebuild`, `_numba_unpickle`), and what starts the threads of a threading layer
(`launch_threads`).
"""

from __future__ import annotations

import ctypes
import functools
import sys
import threading
import time
from collections.abc import Callable
from types import CellType, FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils, event, serialize
from numba.extending import intrinsic

from . import jit
from .kernel_cache import KernelCache, stem_of

_lock = threading.RLock()

# numba calls this Python function while a kernel returns; if a signal handler raised an exception in it, such as
# `KeyboardInterrupt`, that would be lost or end in a `SystemError`. A second call for an object runs no Python code.
serialize._numba_unpickle = functools.cache(serialize._numba_unpickle)

#: Modules of the threading layers.
LAYERS = {"tbb": "tbbpool", "omp": "omppool", "workqueue": "workqueue"}

#: The name under which a module's globals have a copy of themselves, as numba has them.
_NAMESPACE = "__globals_of_kernels__"


def dispatcher_of(kernel: jit.Kernel) -> Any:
    """Return numba's dispatcher of a kernel, which compiles it for the types of its arguments, or loads it.

    What it compiles is a copy of the function, in whose globals numba finds its own `prange` and its own dispatchers.
    Nothing is replaced in the modules themselves, since other threads may be calling their functions.
    """
    with _lock:
        if kernel.built is None:
            options, function = kernel.options, kernel.py_func
            namespace = function.__globals__.setdefault(_NAMESPACE, {})
            decorate: Any = numba.njit(
                error_model="numpy",
                parallel=options.parallel,
                nogil=options.nogil,
                inline="always" if options.inline else "never",
                fastmath={"contract"} if options.contract else False,
                no_cfunc_wrapper=True,
            )
            kernel.built = decorate(_copy(function, namespace))
            if jit.CACHE_FOLDER is not None:
                kernel.built._cache = KernelCache(function, jit.CACHE_FOLDER, jit.report_trouble)
            for name, value in list(function.__globals__.items()):
                namespace[name] = _known(value)
        return kernel.built


def _copy(function: Callable[..., Any], namespace: dict[str, Any]) -> FunctionType:
    """Return a copy of a function with other globals, and with what numba knows in its closure."""
    assert isinstance(function, FunctionType)
    cells = tuple(CellType(_known(cell.cell_contents)) for cell in function.__closure__ or ())
    copy = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__, cells)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _lower_prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Return the type of `jit.prefetch`, and the function that generates its machine code."""

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
    """Return what numba knows a global as: its own `prange`, and dispatchers instead of kernels."""
    if value is jit.prange:
        return numba.prange
    if value is jit.prefetch:
        return _prefetch
    return dispatcher_of(value) if isinstance(value, jit.Kernel) else value


def restart_on_one_thread() -> bool:
    """Run kernels on one thread in a forked process, if its parent had started threads, of which it has none.

    GNU's OpenMP would wait for them forever, so numba ends the process; workqueue would crash.
    """
    try:
        name = numba.threading_layer()
    except ValueError:  # no threads were started
        return False
    layer: Any = sys.modules[f"numba.np.ufunc.{LAYERS[name]}"]
    ctypes.CFUNCTYPE(None, ctypes.c_int)(layer.launch_threads)(1)
    numba.set_num_threads(1)
    return True


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
