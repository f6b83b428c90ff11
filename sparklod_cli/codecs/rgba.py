"""Files of colours and opacities: .npy of uint8 or floats, or raw uint8 or float32 (little-endian)."""

from __future__ import annotations

import math
import os
import tokenize
import warnings
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from ..model.splats import FloatArray
from ..system.errors import FormatError, TruncatedError
from ..system.units import count_of

#: Largest header of a .npy file, bytes; that of a two-dimensional array has 118.
MAX_HEADER = 1 << 12

_READERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
    (3, 0): npy_format.read_array_header_2_0,  # differs in the names of records only, of which there are none
}


@dataclass(frozen=True)
class ArrayLayout:
    """Layout of an array in a file: shape, type, and whether the first index runs fastest."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran_order: bool = False


def read_layout(file: BinaryIO) -> ArrayLayout | None:
    """Read the header of a .npy file, which is left at its numbers; None for another file, left at its beginning.

    Raises:
        FormatError: the header is not that of an array of plain numbers; the text continues a sentence about the file.
    """
    file.seek(0)
    is_npy = file.read(len(npy_format.MAGIC_PREFIX)) == npy_format.MAGIC_PREFIX
    file.seek(0)
    if not is_npy:
        return None
    try:
        version = npy_format.read_magic(file)
        if version not in _READERS:
            raise FormatError("is a .npy file of an unknown version")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of types by their former names
            shape, fortran_order, dtype = _READERS[version](file, max_header_size=MAX_HEADER)
    except (Warning, ValueError, TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError):
        raise FormatError("is not a .npy file of plain numbers: its header is malformed") from None
    if dtype.kind not in "biufc" or min(shape, default=0) < 0:
        raise FormatError(f"is not a .npy file of plain numbers: its header says {dtype} {shape}")
    return ArrayLayout(shape, dtype, fortran_order)


def read_values(file: BinaryIO, layout: ArrayLayout) -> NDArray[Any]:
    """Read the array at the current position of a file; raises `TruncatedError`, see `read_layout`."""
    size = math.prod(layout.shape) * layout.dtype.itemsize
    data = file.read(size)
    if len(data) < size:
        raise TruncatedError(f"ends {size - len(data):,} bytes before its last number")
    values: NDArray[Any] = np.frombuffer(data, layout.dtype)
    return values.reshape(layout.shape, order="F" if layout.fortran_order else "C")


def decode(file: BinaryIO, count: int, rows: slice | None = None) -> FloatArray:
    """Read colours and opacities for the `count` splats of a scene, or for a range: (n, 4) float32, 0..1.

    The type of a raw file follows from its size.

    Raises:
        FormatError: the format, length or values are wrong; the text continues a sentence about the file.
    """
    layout = read_layout(file) or _raw_layout(file, count)
    shape, dtype = layout.shape, layout.dtype
    if len(shape) != 2 or shape[1] != 4 or (dtype != np.uint8 and dtype.kind != "f"):
        raise FormatError(f"has {dtype}{list(shape)}, expected uint8 or floats [{count}, 4]")
    if shape[0] != count:
        raise FormatError(f"has colours for {count_of(shape[0], 'splat')}, the scene has {count:,}")
    if rows is not None and not layout.fortran_order:
        file.seek(rows.start * 4 * dtype.itemsize, os.SEEK_CUR)
        layout, rows = ArrayLayout((rows.stop - rows.start, 4), dtype), None
    values = read_values(file, layout)[rows or slice(None)]
    most = 255 if values.dtype == np.uint8 else 1
    if not ((values >= 0) & (values <= most)).all():
        raise FormatError("has values that are not 0..1")
    return np.ascontiguousarray(values, np.float32) / np.float32(most)


def _raw_layout(file: BinaryIO, count: int) -> ArrayLayout:
    size = os.fstat(file.fileno()).st_size
    if size == 16 * count:
        return ArrayLayout((count, 4), np.dtype("<f4"))
    if size % 4:
        raise FormatError(f"has {size:,} bytes, which are not four a splat")
    return ArrayLayout((size // 4, 4), np.dtype(np.uint8))
