"""Hashes of rows of numbers, by which equal rows are found."""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel, prange
from ...support.jit_types import u4

#: Odd multipliers with irregular bits: 2 ** 64 / golden ratio, and the second of MurmurHash3's finalizer.
SPREAD, MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xC4CEB9FE1A85EC53)
SHIFT = np.uint64(29)


@kernel(u4[:, :], parallel=True)
def hash_rows(bits):
    """A hash of each row: equal for equal rows, different for nearly all others.

    Args:
        bits: (N, D) uint32.

    Returns:
        (N,) uint64.
    """
    out = np.empty(len(bits), np.uint64)
    for i in prange(len(bits)):
        mixed = SPREAD
        for d in range(bits.shape[1]):
            mixed = (mixed ^ np.uint64(bits[i, d])) * MIX
            mixed ^= mixed >> SHIFT
        out[i] = mixed
    return out
