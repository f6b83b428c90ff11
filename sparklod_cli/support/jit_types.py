"""The types of a kernel's arguments, as numba tells them apart, and how a kernel declares them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

#: Bits of `ndarray.flags.num`: contiguous in C's order, in Fortran's, aligned, writeable.
_IN_C, _IN_FORTRAN, _ALIGNED, _WRITEABLE = 0x1, 0x2, 0x100, 0x400
_FLAGS = _IN_C | _IN_FORTRAN | _ALIGNED | _WRITEABLE

#: Marks arrays that cannot be written to, in `describe`.
_READONLY = " readonly"


def _layout(flags: int) -> str:
    order = "C" if flags & _IN_C else "F" if flags & _IN_FORTRAN else "A"
    return order + ("" if flags & _WRITEABLE else _READONLY) + ("" if flags & _ALIGNED else " unaligned")


#: What flags mean to a kernel. An array that is contiguous in both orders counts as one in C's.
_LAYOUTS = {flags: _layout(flags) for flags in range(_FLAGS + 1) if not flags & ~_FLAGS}

#: Types of numpy's scalars that kernels take as arguments: bool, integers, float32 and float64.
_SCALARS = frozenset(np.dtype(code).type for code in "?bhilqBHILQfd")

#: Python's scalars, and the types of numpy that numba takes them for.
_PYTHON: dict[type, str] = {bool: "|b1", float: "<f8", type(None): "none"}

#: Integers below are int64, and from there on uint64.
_INT64_END = 1 << 63


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
    """Decorator that declares the types of a NamedTuple's fields, so that its name can stand in signatures."""

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


def fits(described: str, declared: str) -> bool:
    """Return True if arguments can be passed where those of a signature are declared, both as `describe` has them.

    They have the same types, but arrays that a kernel only reads may be writeable.
    """
    one, other = described.split(", "), declared.split(", ")
    return len(one) == len(other) and all(a in (b, b.replace(_READONLY, "")) for a, b in zip(one, other, strict=True))


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
