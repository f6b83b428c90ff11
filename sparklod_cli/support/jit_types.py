"""The types of a kernel's arguments, as numba tells them apart."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any

import numpy as np

#: Bits of `ndarray.flags.num`: contiguous in C's order, in Fortran's, aligned, writeable.
_IN_C, _IN_FORTRAN, _ALIGNED, _WRITEABLE = 0x1, 0x2, 0x100, 0x400
_FLAGS = _IN_C | _IN_FORTRAN | _ALIGNED | _WRITEABLE


def _layout(flags: int) -> str:
    order = "C" if flags & _IN_C else "F" if flags & _IN_FORTRAN else "A"
    return order + ("" if flags & _WRITEABLE else " readonly") + ("" if flags & _ALIGNED else " unaligned")


#: What flags mean to a kernel. An array that is contiguous in both orders counts as one in C's.
_LAYOUTS = {flags: _layout(flags) for flags in range(_FLAGS + 1) if not flags & ~_FLAGS}

#: Types of numpy's scalars that kernels take as arguments: bool, integers, float32 and float64.
_SCALARS = frozenset(np.dtype(code).type for code in "?bhilqBHILQfd")

#: Python's scalars, and the types of numpy that numba takes them for.
_PYTHON: dict[type, str] = {bool: "|b1", float: "<f8", type(None): "none"}

#: Integers below are int64, and from there on uint64.
_INT64_END = 1 << 63


def key_of(values: Iterable[Any]) -> Hashable | None:
    """A key that is equal for values of the same types only; None if this module does not know one of the types.

    Two keys may stand for the same types.
    """
    keys: list[Hashable] = []
    for value in values:
        kind: Any = type(value)
        if kind is np.ndarray or kind is np.memmap:
            keys.append((value.dtype, value.ndim, _LAYOUTS[value.flags.num & _FLAGS]))
        elif kind in _SCALARS or kind in _PYTHON or (kind is int and -_INT64_END <= value < _INT64_END):
            keys.append(kind)
        elif kind is tuple or (isinstance(value, tuple) and hasattr(kind, "_fields")):
            inner = key_of(value)
            if inner is None:
                return None
            keys.append((kind, inner))
        else:
            return None
    return tuple(keys)


def describe(values: Iterable[Any]) -> str | None:
    """A text that is equal for values of the same types only, in every process; None if `key_of` would return it.

    It is also None for arrays of types that kernels of this package do not take.
    """
    texts = [_describe(value) for value in values]
    return None if None in texts else f"({', '.join(map(str, texts))})"


def _describe(value: Any) -> str | None:
    kind = type(value)
    if key_of([value]) is None:
        return None
    if isinstance(value, np.ndarray):
        text = _describe_dtype(value.dtype)
        return text and f"{text} {value.ndim}d {_LAYOUTS[value.flags.num & _FLAGS]}"
    if isinstance(value, tuple):
        inner = describe(value)
        return inner and f"{kind.__module__}.{kind.__qualname__}{inner}"
    if kind is int:
        return "<i8"
    return _PYTHON[kind] if kind in _PYTHON else np.dtype(kind).str


def _describe_dtype(dtype: np.dtype[Any]) -> str | None:
    if dtype.subdtype is not None:
        base, shape = dtype.subdtype
        text = _describe_dtype(base)
        return text and f"{text}{shape}"
    if dtype.fields is None:
        return dtype.str if dtype.isnative and dtype.kind in "biuf" else None
    fields = []
    for name, (inner, offset, *_) in dtype.fields.items():
        text = _describe_dtype(inner)
        if text is None:
            return None
        fields.append(f"{name!r}: {text} at {offset}")
    return f"{{{', '.join(fields)}}} of {dtype.itemsize}{' aligned' if dtype.isalignedstruct else ''}"
