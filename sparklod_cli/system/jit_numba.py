"""Interface to numba for `jit`; loaded when a kernel is called for the first time.

Of numba's undocumented interfaces, these modules and `kernel_cache` use the cache of a dispatcher (`_cache`), the
conversion of a compiled function to bytes and back (`_reduce`, `_rebuild`, `_numba_unpickle`), and the options
`no_cfunc_wrapper` and `no_cpython_wrapper`.
"""

from __future__ import annotations

import functools
import gc
import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from types import FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils, event, serialize
from numba.core.compiler import Compiler
from numba.extending import intrinsic

from .kernel_cache import stem_of

# numba calls this Python function while a kernel returns; if a signal handler raised an exception in it, such as
# `KeyboardInterrupt`, that would be lost or end in a `SystemError`. A second call for an object runs no Python code.
serialize._numba_unpickle = functools.cache(serialize._numba_unpickle)


def compiled(function: FunctionType, options: Mapping[str, Any], *, is_apart: bool, has_wrapper: bool) -> Any:
    """Return numba's dispatcher of a function, which compiles it when it is called.

    Args:
        options: keyword arguments of `numba.njit`.
        is_apart: its arrays do not overlap.
        has_wrapper: it also gets the code that makes it callable from Python.
    """
    decorate: Any = numba.njit(
        error_model="numpy",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=not has_wrapper,
        pipeline_class=_ApartCompiler if is_apart else Compiler,
        **options,
    )
    return decorate(function)


class _ApartCompiler(Compiler):
    """Compiles functions whose arrays do not overlap, which LLVM then need not test before it vectorizes loops."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def calling(compiled: Any, function: Callable[..., Any]) -> Any:
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


#: `jit.prefetch` in machine code.
prefetch: Any = intrinsic(_lower_prefetch)


class _CompilationListener(event.Listener):
    """Reports the compilation of kernels called from Python, not of the kernels that these call.

    Python looks for garbage only afterwards: a compiler's millions of live objects make that a tenth of the time.
    """

    listeners: Sequence[tuple[Callable[[str], None], Callable[[float], None], object]] = ()  # `jit.listeners`
    _depth, _since, _collects = 0, 0.0, False

    def on_start(self, event: event.Event) -> None:
        self._depth += 1  # numba compiles on one thread at a time
        if self._depth == 1:
            self._since, self._collects = time.perf_counter(), gc.isenabled()
            gc.disable()
            for begun, _, _ in self.listeners:
                begun(stem_of(event.data["dispatcher"].py_func))

    def on_end(self, event: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            if self._collects:
                gc.enable()
            for _, done, _ in self.listeners:
                done(time.perf_counter() - self._since)


compilations = _CompilationListener()
event.register("numba:compile", compilations)
