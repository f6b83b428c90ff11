"""Kernels as Python functions, where NUMBA_DISABLE_JIT asks for them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

#: Whether a kernel runs on a thread, as `in_python`: one that it calls gets its arguments as they are.
_running = threading.local()


class Record(np.void):  # type: ignore[misc] # final for type checkers only
    """An element of an array of records with its fields as attributes, also "size", which `numpy.record` hides."""

    def __getattribute__(self, name: str) -> Any:
        fields = np.void.__getattribute__(self, "dtype").names or ()
        return self[name] if name in fields else np.void.__getattribute__(self, name)

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value


def interpreted(function: Callable[..., Any], ranges: bool) -> Callable[..., Any]:
    """Return a kernel as a function that Python runs.

    As in machine code, fields of records are attributes, integers overflow without a warning, and results are numbers
    of Python.

    Args:
        ranges: the function takes the ends of a range of rows; Python gives the second one only.
    """

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        if getattr(_running, "in_python", False):
            return function(*arguments)
        _running.in_python = True
        try:
            with np.errstate(all="ignore"):
                return _plain(function(*((0,) if ranges else ()), *map(_with_records, arguments)))
        finally:
            _running.in_python = False

    return run


def _with_records(argument: Any) -> Any:
    """Return an argument whose arrays of records have elements of `Record`."""
    if isinstance(argument, tuple) and hasattr(argument, "_fields"):
        return type(argument)(*map(_with_records, argument))
    if isinstance(argument, np.ndarray) and argument.dtype.names:
        return argument.view((Record, argument.dtype))
    return argument


def _plain(result: Any) -> Any:
    """Return a result with numbers of Python."""
    if isinstance(result, tuple):
        numbers = map(_plain, result)
        return type(result)(*numbers) if hasattr(result, "_fields") else tuple(numbers)
    return result.item() if isinstance(result, np.generic) else result
