"""Kernels for NVIDIA cards: Python functions that numba's CUDA target compiles. Import it only where a card is used.

What kernels for processors call, such as the falloff of a splat, is compiled for the card from the same source.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba import cuda

from .jit import Kernel, Type, out

#: True if numba simulates a card: NUMBA_ENABLE_CUDASIM=1.
SIMULATED = bool(numba.config.ENABLE_CUDASIM)

#: Threads of a block of kernels whose threads each process one item. Chosen.
BLOCK = 128

#: The name under which a module's globals have a copy of themselves, as the CUDA target has them.
_NAMESPACE = "__globals_of_cuda_kernels__"

#: numpy as device functions know it: of its functions of numbers, the CUDA target has only those of `math`.
_NUMPY = ModuleType("numpy_on_cards")
vars(_NUMPY).update(sqrt=math.sqrt, exp=math.exp, __getattr__=functools.partial(getattr, np))


class CudaKernel:
    """A function that runs on a card, compiled when it is first launched.

    Attributes:
        py_func: the Python function.
        declared: the types of its arguments, see `jit.Type`.
    """

    def __init__(self, function: Callable[..., Any], declared: Sequence[Any]) -> None:
        self.__doc__, self.__name__ = function.__doc__, function.__name__
        self.py_func, self.declared = function, declared

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's kernel."""
        return cuda.jit(_copy(self.py_func))

    @property
    def signature(self) -> tuple[Any, ...]:
        """Numba's types of the arguments."""
        return tuple(map(_numba_type, self.declared))

    def launch(self, blocks: int | tuple[int, int], threads: int, *arguments: Any) -> None:
        """Run it in blocks of threads; do nothing without blocks."""
        if blocks:
            self.dispatcher[blocks, threads](*arguments)

    def for_each(self, count: int, *arguments: Any) -> None:
        """Run it on at least `count` threads, in blocks of BLOCK."""
        self.launch(-(-count // BLOCK), BLOCK, *arguments)


def cuda_kernel(*types: Any) -> Callable[[Callable[..., Any]], CudaKernel]:
    """Decorate a function that is launched on a card, with the types of its arguments."""
    return lambda function: CudaKernel(function, types)


def _copy(function: Callable[..., Any]) -> FunctionType:
    """Return a copy of a function in whose globals are device functions instead of kernels for processors."""
    assert isinstance(function, FunctionType)
    if _NAMESPACE not in function.__globals__:
        namespace = function.__globals__[_NAMESPACE] = {}
        for name, value in list(function.__globals__.items()):
            namespace[name] = _known(value)
    copy = FunctionType(function.__code__, function.__globals__[_NAMESPACE], function.__name__, function.__defaults__)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    return copy


def _known(value: Any) -> Any:
    """Return what the CUDA target knows a global as."""
    if value is np and not SIMULATED:
        return _NUMPY
    return _device_function(value) if isinstance(value, Kernel) else value


@functools.cache
def _device_function(kernel: Kernel) -> Any:
    """Return a function that kernels on the card can call; in the simulator, a function of Python."""
    copy = _copy(kernel.py_func)
    return copy if SIMULATED else cuda.jit(device=True)(copy)


def _numba_type(declared: Any) -> Any:
    """Return numba's type of a declared argument."""
    if isinstance(declared, out):
        declared = declared.declared
    assert isinstance(declared, Type)
    scalar = numba.from_dtype(declared.dtype)
    return numba.types.Array(scalar, declared.axes, "C") if declared.axes else scalar
