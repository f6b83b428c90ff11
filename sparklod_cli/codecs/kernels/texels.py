"""Fills columns of splats from the pixels of SOG's images: uint32 of A R G B from the most significant byte."""

from __future__ import annotations

import numpy as np

from ...system.jit import f4, i8, kernel, out, u1, u4

_BYTE = np.uint32(255)
_8, _16, _24 = np.uint32(8), np.uint32(16), np.uint32(24)


@kernel(u4[:], out(u1[:, :]), i8)
def place_bytes(pixels, out, place):
    """Put red, green and blue into byte `place` of each of the three words of (N, 12) bytes."""
    for i in range(len(pixels)):
        p = pixels[i]
        out[i, place] = p >> _16 & _BYTE
        out[i, 4 + place] = p >> _8 & _BYTE
        out[i, 8 + place] = p & _BYTE


@kernel(u4[:, :], f4[:, :], out(f4[:, :]))
def look_up_words(words, tables, out):
    """Fill (N, 3) float32 by (3, 65536) tables and the lower halves of (N, 3) uint32, which may be the same memory."""
    for i in range(len(words)):
        for axis in range(3):
            out[i, axis] = tables[axis, words[i, axis] & np.uint32(0xFFFF)]


@kernel(u4[:], u4[:], f4[:, :], out(f4[:, :]))
def look_up(pixels, shifts, tables, out):
    """Fill (N, C) float32 by (C, 256) tables and the bytes of (N,) pixels at (C,) bit `shifts`."""
    for i in range(len(pixels)):
        for k in range(len(shifts)):
            out[i, k] = tables[k, pixels[i] >> shifts[k] & _BYTE]


@kernel(u4[:], f4[:], out(f4[:, :]))
def fill_quats(pixels, components, out):
    """Fill (N, 4) quaternions x y z w; `components` has the value of each of 256 codes.

    Red, green and blue are the codes of all components but the largest, in the order w x y z; alpha minus 252 is the
    index of that, and anything below gives NaN.
    """
    one = np.float32(1)
    for i in range(len(pixels)):
        p = pixels[i]
        largest = np.int64(p >> _24) - 252
        a, b, c = components[p >> _16 & _BYTE], components[p >> _8 & _BYTE], components[p & _BYTE]
        square = a * a + b * b + c * c
        rest = np.float32(0)
        if square < one:
            rest = np.sqrt(one - square)
        elif square > one:  # rounding made them longer than 1
            over = one / np.sqrt(square)
            a, b, c = a * over, b * over, c * over
        if largest == 0:
            w, x, y, z = rest, a, b, c
        elif largest == 1:
            w, x, y, z = a, rest, b, c
        elif largest == 2:
            w, x, y, z = a, b, rest, c
        elif largest == 3:
            w, x, y, z = a, b, c, rest
        else:
            w = x = y = z = np.float32(np.nan)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = x, y, z, w


@kernel(u4[:], f4[:, :], out(f4[:, :]), returns=i8)
def gather_rows(pixels, rows, out):
    """Fill `out` (N, D) with the rows of labels, red + 256 * green, unless one is beyond the last row.

    Returns:
        the largest label.
    """
    largest = np.int64(0)
    for i in range(len(pixels)):
        p = pixels[i]
        largest = max(largest, np.int64(p >> _16 & _BYTE | p & np.uint32(0xFF00)))
    if largest < len(rows):
        for i in range(len(pixels)):
            label = pixels[i] >> _16 & _BYTE | pixels[i] & np.uint32(0xFF00)
            for k in range(rows.shape[1]):
                out[i, k] = rows[label, k]
    return largest
