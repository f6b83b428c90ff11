"""Counts digits of numbers for percentiles, and measures spherical harmonics."""

from __future__ import annotations

import math

import numpy as np

from ...system.jit import kernel
from ...system.jit_types import b1, f4, f8, i8, out, u4, u8

#: Bits of a digit.
DIGIT_BITS = 16


@kernel(
    (f4[:], u4[:], i8, u4[:], out(i8[:, :]), out(u4[:, :]), out(b1[:, :])),
    (f8[:], u8[:], i8, u8[:], out(i8[:, :]), out(u8[:, :]), out(b1[:, :])),
    nogil=True,
)
def count_digits(values, bits, shift, prefixes, counts, seen, mixed):
    """Count a digit of the keys of those finite numbers whose digits before it are given.

    The keys of numbers are whole numbers in the same order, that of -0 the same as of 0.

    Args:
        values: (n,) float32 or float64.
        bits: (n,) the same as uint32 or uint64.
        shift: of keys, 0 or more multiples of DIGIT_BITS, after which the digit is the lowest.
        prefixes: (R,) ascending, what is above that digit; all 0 where it is the first.
        counts: (R, 65536) int64, to which numbers are added, by prefix and digit.
        seen: (R, 65536) of the type of `bits`, a key of each that was counted.
        mixed: (R, 65536) bool, set where keys differ.

    Returns:
        count, total: of all finite numbers, and their sum.
    """
    width = bits.itemsize * 8
    one = bits.dtype.type(1)
    sign = one << bits.dtype.type(width - 1)
    low, high = bits.dtype.type(shift), bits.dtype.type(shift + DIGIT_BITS)
    is_first = shift + DIGIT_BITS == width
    count, total = 0, 0.0
    for i in range(len(values)):
        value = values[i]
        if not math.isfinite(value):
            continue
        count += 1
        total += np.float64(value)
        key = bits[i]
        if key == sign:
            key = bits.dtype.type(0)
        key = ~key if key & sign else key | sign
        row = 0
        if not is_first:
            prefix = key >> high
            while row < len(prefixes) and prefixes[row] != prefix:
                row += 1
            if row == len(prefixes):
                continue
        digit = np.int64((key >> low) & bits.dtype.type((1 << DIGIT_BITS) - 1))
        if counts[row, digit] == 0:
            seen[row, digit] = key
        elif seen[row, digit] != key:
            mixed[row, digit] = True
        counts[row, digit] += 1
    return count, total


@kernel(f4[:, :, :], i8, i8, out(f8[:]), nogil=True)
def sh_lengths(sh, first, last, out):
    """Fill the root mean squares of the coefficients of splats from `first` up to `last`.

    Args:
        sh: (n, K, 3) float32.
        first, last: of the K.
        out: (n,) float64, filled.
    """
    for splat in range(len(sh)):
        total = 0.0
        for k in range(first, last):
            for c in range(3):
                value = np.float64(sh[splat, k, c])
                total += value * value
        out[splat] = math.sqrt(total / (3 * (last - first)))
