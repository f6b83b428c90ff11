"""The types of a kernel's arguments, as it declares them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np


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
