"""numpy's .npy files of plain numbers. Their header is Python source; it is matched with a pattern, not evaluated."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..support.errors import FormatError, TruncatedError

MAGIC = b"\x93NUMPY"

#: Size in bytes of the field with the length of the header, by major version.
LENGTH_BYTES = {1: 2, 2: 4, 3: 4}

#: Largest header, bytes; that of a two-dimensional array has 118.
MAX_HEADER = 1 << 12

#: Keys of a header and the values that are accepted, as Python writes them.
KEYS = {
    "descr": r"""['"]([<>|=]?[biufc]\d{1,2})['"]""",
    "fortran_order": r"(True|False)",
    "shape": r"\(([\d,\s]{0,200})\)",
}
_HEADER = re.compile(
    r"\{" + "".join(rf"(?=[^{{}}]*['\"]{key}['\"]\s*:\s*{value})" for key, value in KEYS.items()) + r"[^{}]*\}\s*"
)


@dataclass(frozen=True)
class Layout:
    """The layout of an array in a file.

    Attributes:
        shape: of the array.
        dtype: of its numbers.
        fortran_order: the first index runs fastest.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran_order: bool = False


def read_layout(file: BinaryIO) -> Layout | None:
    """The layout of a .npy file, which is left at its numbers; None for another file, which is left at its beginning.

    Raises:
        FormatError: the header is not that of an array of plain numbers; the text continues a sentence about the file.
    """
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        file.seek(0)
        return None
    version = file.read(2)
    size = LENGTH_BYTES.get(version[0]) if len(version) == 2 else None
    if size is None:
        raise FormatError("is a .npy file of an unknown version")
    length = int.from_bytes(file.read(size), "little")
    header = file.read(min(length, MAX_HEADER))
    found = _HEADER.fullmatch(header.decode("latin-1")) if length <= MAX_HEADER else None
    if found is None:
        raise FormatError("is not a .npy file of plain numbers: its header is malformed")
    try:
        dtype = np.dtype(found[1])
        shape = tuple(int(side) for side in found[3].replace(",", " ").split())
    except (TypeError, ValueError):
        raise FormatError(f"is not a .npy file of plain numbers: its header says {found[1]!r}") from None
    if dtype.hasobject or not dtype.itemsize:
        raise FormatError(f"is not a .npy file of plain numbers: its header says {found[1]!r}")
    return Layout(shape, dtype, found[2] == "True")


def read_values(file: BinaryIO, layout: Layout) -> NDArray[Any]:
    """The array at the current position of a file. The caller has checked that its shape is the expected one.

    Raises:
        TruncatedError: the file is too short; the text continues a sentence about the file.
    """
    size = math.prod(layout.shape) * layout.dtype.itemsize
    data = file.read(size)
    if len(data) < size:
        raise TruncatedError(f"ends {size - len(data):,} bytes before its last number")
    values: NDArray[Any] = np.frombuffer(data, layout.dtype)
    return values.reshape(layout.shape, order="F" if layout.fortran_order else "C")
