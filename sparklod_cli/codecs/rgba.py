"""Files of colours and opacities: .npy of uint8 or floats, or raw uint8 or float32 (little-endian)."""

from __future__ import annotations

import os
from typing import BinaryIO

import numpy as np

from ..model.splats import FloatArray
from ..support.errors import FormatError
from ..support.units import count_of
from . import npy


def decode(file: BinaryIO, count: int, rows: slice | None = None) -> FloatArray:
    """Colours and opacities for the `count` splats of a scene: (count, 4) float32, 0..1.

    The type of a raw file follows from its size.

    Args:
        file: of all of them.
        count: of splats.
        rows: a range of them, from a start to a stop, to read alone; None for all.

    Raises:
        FormatError: it is neither, of another length, or has values that are not 0..1; continues a sentence about the
            file.
    """
    layout = npy.read_layout(file) or _raw_layout(file, count)
    shape, dtype = layout.shape, layout.dtype
    if len(shape) != 2 or shape[1] != 4 or (dtype != np.uint8 and dtype.kind != "f"):
        raise FormatError(f"has {dtype}{list(shape)}, expected uint8 or floats [{count}, 4]")
    if shape[0] != count:
        raise FormatError(f"has colours for {count_of(shape[0], 'splat')}, the scene has {count:,}")
    if rows is not None and not layout.fortran_order:
        file.seek(rows.start * 4 * dtype.itemsize, os.SEEK_CUR)
        layout, rows = npy.Layout((rows.stop - rows.start, 4), dtype), None
    values = npy.read_values(file, layout)[rows or slice(None)]
    most = 255 if values.dtype == np.uint8 else 1
    if not ((values >= 0) & (values <= most)).all():
        raise FormatError("has values that are not 0..1")
    return np.ascontiguousarray(values, np.float32) / np.float32(most)


def _raw_layout(file: BinaryIO, count: int) -> npy.Layout:
    """The layout of a file without a header, by its size."""
    size = os.fstat(file.fileno()).st_size
    if size == 16 * count:
        return npy.Layout((count, 4), np.dtype("<f4"))
    if size % 4:
        raise FormatError(f"has {size:,} bytes, which are not four a splat")
    return npy.Layout((size // 4, 4), np.dtype(np.uint8))
