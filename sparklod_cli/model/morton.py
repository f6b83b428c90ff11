"""The Morton curve: an order of points that keeps most neighbours in space together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .splats import FloatArray

#: Bits of a coordinate along each axis of the bounding box: three of them fill a word of 64 bits.
BITS = 21

#: Steps that insert two zeros between the bits of a word: shift, and mask of the result.
_SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def order(center: FloatArray) -> NDArray[np.intp]:
    """Return the order of points along the Morton curve of their box, which has 2 ** BITS cells along each axis.

    Points of one cell keep their order. `center` is (N, 3), finite.
    """
    cells = np.zeros(center.shape, np.uint32)
    for axis in range(3) if len(center) else ():
        column = center[:, axis].astype(np.float64)
        low, extent = column.min(), np.ptp(column)
        if extent > 0:
            cells[:, axis] = np.minimum((column - low) / extent * 2**BITS, 2**BITS - 1)
    return order_of_cells(cells)


def order_of_cells(cells: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.intp]:
    """Return the order of points along the Morton curve, by (N, 3) numbers of their cells, below 2 ** BITS.

    Codes interleave the bits of z, y and x, z first. Points of one cell keep their order.
    """
    codes = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        words = cells[:, axis].astype(np.uint64)
        for places, mask in _SPREADING:
            words = (words | words << np.uint64(places)) & np.uint64(mask)
        codes |= words << np.uint64(axis)
    return np.argsort(codes, kind="stable")
