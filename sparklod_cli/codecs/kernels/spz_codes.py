"""Counts the codes of an SPZ file, and measures its splats by them: a column of bytes has few values."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from ...support.jit_types import f4, i2, i8, out, u1

#: Bits of a coordinate that are counted at a time, half of it.
HALF_BITS = 12
#: What makes whole numbers of 24 bits with a sign ascend from 0 on.
LOWEST = 1 << 23


@kernel(u1[:, :], out(i8[:, :]), nogil=True)
def count_bytes(codes, counts):
    """Counts the bytes of each column.

    Args:
        codes: (n, k) uint8.
        counts: (k, 256) int64, to which they are added.
    """
    for row in range(len(codes)):
        for column in range(codes.shape[1]):
            counts[column, codes[row, column]] += 1


@kernel(u1[:, :], out(i8[:, :]), nogil=True)
def count_ends(codes, counts):
    """Counts the largest and the smallest byte of rows.

    Args:
        codes: (n, 3) uint8.
        counts: (256, 256) int64, to which they are added, by largest and smallest.
    """
    for row in range(len(codes)):
        a, b, c = codes[row, 0], codes[row, 1], codes[row, 2]
        counts[max(a, b, c), min(a, b, c)] += 1


@kernel(u1[:, :], i8, i8, out(i8[:]), nogil=True)
def count_squares(codes, first, last, counts):
    """Counts sums of squares of what bytes differ from 128 by.

    Args:
        codes: (n, m) uint8.
        first, last: of the m, those from `first` up to `last` are summed.
        counts: (more than the largest sum,) int64, to which they are added.
    """
    for row in range(len(codes)):
        total = np.int32(0)
        for column in range(first, last):
            value = np.int32(codes[row, column]) - np.int32(128)
            total += value * value
        counts[total] += 1


@kernel(u1[:, :], i8, i8, i2[:], out(i8[:, :]), nogil=True)
def count_halves(codes, axis, shift, rows, counts):
    """Counts half of the bits of a coordinate.

    Args:
        codes: (n, 9) uint8, three whole numbers of 24 bits with a sign.
        axis: which of the three.
        shift: bits below the half that is counted: HALF_BITS, or 0.
        rows: (1 << HALF_BITS,) int16 row of `counts` by the upper half, -1 of numbers that are not counted.
        counts: (R, 1 << HALF_BITS) int64, to which they are added.

    Returns:
        sum of all coordinates.
    """
    total = 0
    low, middle, high = 3 * axis, 3 * axis + 1, 3 * axis + 2
    for row in range(len(codes)):
        key = (
            np.int32(codes[row, high]) << 16 | np.int32(codes[row, middle]) << 8 | np.int32(codes[row, low])
        ) ^ LOWEST
        total += key
        to = rows[key >> HALF_BITS]
        if to >= 0:
            counts[to, (key >> shift) & ((1 << HALF_BITS) - 1)] += 1
    return total - LOWEST * len(codes)


@kernel(u1[:, :], u1[:, :], f4[:], f4[:], out(f4[:]), nogil=True)
def fill_sizes(scales, alphas, scale_of, factor_of, size):
    """Feature sizes, as `gaussian.spark_size` computes them.

    Args:
        scales: (n, 3) uint8.
        alphas: (n, 1) uint8.
        scale_of: (256,) float32 of each code of a scale.
        factor_of: (256,) float32, feature size over mean scale of each code of an opacity.
        size: (n,) float32, filled.
    """
    for row in range(len(scales)):
        mean = scale_of[scales[row, 0]] + scale_of[scales[row, 1]]
        mean += scale_of[scales[row, 2]]
        size[row] = factor_of[alphas[row, 0]] * (mean / np.float32(3))


@kernel(u1[:, :], u1[:, :], u1[:, :], f4[:], f4[:], f4, out(f4[:, :]), nogil=True)
def fill_extremes(alphas, scales, positions, opacity_of, scale_of, step, found):
    """Opacities, largest scales and largest absolute coordinates.

    Args:
        alphas: (n, 1) uint8.
        scales: (n, 3) uint8, ascending with the scale.
        positions: (n, 9) uint8, as for `count_halves`.
        opacity_of, scale_of: (256,) float32 of each code.
        step: float32, of coordinates.
        found: (3, n) float32, filled.
    """
    for row in range(len(scales)):
        furthest = 0
        for axis in range(0, 9, 3):
            low, middle, high = positions[row, axis], positions[row, axis + 1], positions[row, axis + 2]
            key = (np.int32(high) << 16 | np.int32(middle) << 8 | np.int32(low)) ^ LOWEST
            furthest = max(furthest, abs(key - LOWEST))
        found[0, row] = opacity_of[alphas[row, 0]]
        found[1, row] = scale_of[max(scales[row, 0], scales[row, 1], scales[row, 2])]
        found[2, row] = np.float32(furthest) * step


@kernel(u1[:, :], f4[:], out(f4[:, :]), nogil=True)
def look_up(codes, table, out):
    """What each byte stands for.

    Args:
        codes: (n, k) uint8.
        table: (256,) float32.
        out: (n, k) float32, filled.
    """
    for row in range(len(codes)):
        for column in range(codes.shape[1]):
            out[row, column] = table[codes[row, column]]
