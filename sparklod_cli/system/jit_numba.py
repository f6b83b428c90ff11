"""Kernels as numba has them; loaded when one is called for the first time, because numba takes half a second to load.

Of what numba does not document, this and `kernel_cache` use the cache of a dispatcher (`_cache`), what makes bytes of a
compiled function and back (`_reduce`, `_rebuild`, `_numba_unpickle`), and the options `no_cfunc_wrapper` and
`no_cpython_wrapper`.
"""

from __future__ import annotations

import functools
import gc
import inspect
import threading
import time
from collections.abc import Callable
from types import CellType, FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils, event, serialize
from numba.core.compiler import Compiler
from numba.extending import intrinsic

from . import jit
from .kernel_cache import KernelCache, stem_of

_lock = threading.RLock()

# numba calls this Python function while a kernel returns; if a signal handler raised an exception in it, such as
# `KeyboardInterrupt`, that would be lost or end in a `SystemError`. A second call for an object runs no Python code.
serialize._numba_unpickle = functools.cache(serialize._numba_unpickle)

#: The name under which a module's globals have a copy of themselves, as numba has them.
_NAMESPACE = "__globals_of_kernels__"


def dispatcher_of(kernel: jit.Kernel) -> Any:
    """Return numba's dispatcher that Python calls, which compiles a kernel for types of arguments, or loads it."""
    with _lock:
        if kernel.built is None:
            inner = _inner_of(kernel)
            kernel.built = inner if kernel.has_wrapper else _calling(inner, kernel.py_func)
            if kernel.declared:
                _keep(kernel.built, kernel.py_func)
                if jit.before_first_call is not None:
                    jit.before_first_call(kernel)
        return kernel.built


def _inner_of(kernel: jit.Kernel) -> Any:
    """Return numba's dispatcher that other kernels call.

    What it compiles is a copy of the function, in whose globals numba finds its own dispatchers.
    Nothing is replaced in the modules themselves, since other threads may be calling their functions.
    """
    if kernel.inner is None:
        function: Any = kernel.py_func
        namespace = function.__globals__.setdefault(_NAMESPACE, {})
        cells = tuple(CellType(_known(cell.cell_contents)) for cell in function.__closure__ or ())
        copy = FunctionType(function.__code__, namespace, function.__name__, function.__defaults__, cells)
        copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
        copy.__kwdefaults__ = function.__kwdefaults__
        decorate: Any = numba.njit(
            error_model="numpy",
            no_cfunc_wrapper=True,
            no_cpython_wrapper=not kernel.has_wrapper,
            pipeline_class=_ApartCompiler if kernel.ranges else Compiler,
            **kernel.options,
        )
        kernel.inner = decorate(copy)
        if not kernel.declared:
            _keep(kernel.inner, function)
        for name, value in list(function.__globals__.items()):
            namespace[name] = _known(value)
    return kernel.inner


def _keep(dispatcher: Any, function: Callable[..., Any]) -> None:
    """Have a dispatcher keep machine code in the cache."""
    if jit.CACHE_FOLDER is not None or jit.READ_FOLDERS:
        dispatcher._cache = KernelCache(function, jit.CACHE_FOLDER, jit.READ_FOLDERS, jit.report_trouble)


class _ApartCompiler(Compiler):
    """Compiles functions whose arrays do not overlap, which LLVM then need not test before it vectorizes loops."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def _calling(compiled: Any, function: Callable[..., Any]) -> Any:
    """Return the dispatcher of a function that calls another, which LLVM makes a part of it.

    This also makes loops of ranges fast. LLVM optimizes a function, and then numba removes the counts of references to
    arrays, which keep loops from being vectorized. As a part of another function it is optimized again: vectorized.
    """
    names, namespace = ", ".join(inspect.signature(function).parameters), dict[str, Any](compiled=compiled)
    # Not (*arguments): numba does not recognise the types of those that it loads from the cache.
    exec(f"def call({names}):\n    return compiled({names})", namespace)
    call = namespace["call"]
    for name in ("__module__", "__name__", "__qualname__"):
        setattr(call, name, getattr(function, name))
    return numba.njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(call)


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
    """Return what numba knows a global as: dispatchers instead of kernels."""
    if value is jit.prefetch:
        return _prefetch
    return _inner_of(value) if isinstance(value, jit.Kernel) else value


class _OnCompile(event.Listener):
    """Reports the compilation of kernels called from Python, not of the kernels that those call.

    Python looks for garbage only afterwards: a compiler's millions of live objects make that a tenth of the time.
    """

    _depth, _since, _collects = 0, 0.0, False

    def on_start(self, event: event.Event) -> None:
        self._depth += 1  # numba compiles on one thread at a time
        if self._depth == 1:
            self._since, self._collects = time.perf_counter(), gc.isenabled()
            gc.disable()
            jit.report_begun(stem_of(event.data["dispatcher"].py_func))

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            if self._collects:
                gc.enable()
            jit.report_done(time.perf_counter() - self._since)


event.register("numba:compile", _OnCompile())
