"""Percentiles of numbers that pass by block by block, in memory that does not depend on how many there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lod.kernels.digits import DIGIT_BITS, count_digits
from ..model.splats import FloatArray

#: As many numbers are kept and sorted, which takes less time. Chosen.
KEPT = 1 << 18


class Percentiles:
    """Exact percentiles, as numpy's are (linear between two numbers), and the mean.

    More than `KEPT` numbers pass at most once for each 16 of their bits, 2 times as float32 and 4 times as float64: a
    pass counts the next digit of those numbers whose digits before are those of a number that is looked for (radix
    selection), until all that share these digits are equal, as those of a format with few codes soon are. Fewer numbers
    pass once.

    Args:
        levels: percentiles, 0 to 100.
        dtype: of the numbers, float32 or float64.

    Attributes:
        count: of numbers.
        passes: that are still to come.
    """

    def __init__(self, levels: Sequence[float], dtype: Any) -> None:
        self._shares = np.asarray(levels, np.float64) / 100
        self._float: np.dtype[np.floating[Any]] = np.dtype(dtype)
        self._key = np.dtype(f"u{self._float.itemsize}")
        self.count, self._sum = 0, 0.0
        self.passes = 8 * self._float.itemsize // DIGIT_BITS
        self._first = True
        self._kept: list[FloatArray] | None = []  # in the first pass, as long as they are few
        self._look_for(np.zeros(1, self._key))
        self._ranks = np.zeros(0, np.int64)  # places of these numbers among all in order
        self._places = np.zeros(0, np.int64)  # the same, among those with the same prefix
        self._found = np.zeros(0, self._key)  # prefix of each

    def _look_for(self, prefixes: NDArray[np.unsignedinteger]) -> None:
        """Begins a pass that counts the numbers whose keys begin so."""
        shape = len(prefixes), 1 << DIGIT_BITS
        self._prefixes, self._counts = prefixes, np.zeros(shape, np.int64)
        self._seen, self._mixed = np.zeros(shape, self._key), np.zeros(shape, np.bool_)

    def add(self, values: FloatArray) -> None:
        """Add (n,) numbers, the same in every pass; those that are not finite are left out."""
        if not self.passes:
            return
        values = np.ascontiguousarray(values)
        count, total = count_digits(
            values,
            values.view(self._key),
            DIGIT_BITS * (self.passes - 1),
            self._prefixes,
            self._counts,
            self._seen,
            self._mixed,
        )
        if not self._first:
            return
        self.count += count
        self._sum += total
        if self._kept is not None:
            self._kept.append(values[np.isfinite(values)])
            if self.count > KEPT:
                self._kept = None

    def end_pass(self) -> None:
        """End a pass over all numbers."""
        if not self.passes:
            return
        if self._first:
            self._first = False
            if not self.count:
                self.passes = 0
                return
            low = np.floor((self.count - 1) * self._shares).astype(np.int64)
            self._ranks = np.unique(np.concatenate([low, np.minimum(low + 1, self.count - 1)]))
            self._places, self._found = self._ranks.copy(), np.zeros(len(self._ranks), self._key)
        if self._kept is not None:
            self._found = np.sort(_keys(np.concatenate(self._kept), self._key))[self._ranks]
            self._kept, self.passes = None, 0
            return
        sums = np.cumsum(self._counts, axis=1)
        rows = np.searchsorted(self._prefixes, self._found)
        digits = [
            int(np.searchsorted(sums[row], place, side="right")) for row, place in zip(rows, self._places, strict=True)
        ]
        if not self._mixed[rows, digits].any():
            self._found, self.passes = self._seen[rows, digits], 0
        else:
            for at, (row, digit) in enumerate(zip(rows, digits, strict=True)):
                self._places[at] -= sums[row, digit - 1] if digit else 0
                self._found[at] = (int(self._found[at]) << DIGIT_BITS) | digit
            self.passes -= 1
        self._look_for(np.unique(self._found) if self.passes else self._prefixes[:0])

    def values(self) -> NDArray[np.float64]:
        """Return the percentiles, after the last pass; there must be numbers."""
        places = (self.count - 1) * self._shares
        low = np.floor(places).astype(np.int64)
        share = places - low
        numbers = _floats(self._found, self._float).astype(np.float64)
        below, above = (
            numbers[np.searchsorted(self._ranks, ranks)] for ranks in (low, np.minimum(low + 1, self.count - 1))
        )
        # From the nearer end, as numpy does.
        found: NDArray[np.float64] = np.where(
            share >= 0.5, above - (above - below) * (1 - share), below + (above - below) * share
        )
        return found

    @property
    def mean(self) -> float:
        """Mean of the numbers; there must be some."""
        return self._sum / self.count


def _keys(values: FloatArray, kind: np.dtype[np.unsignedinteger]) -> NDArray[np.unsignedinteger]:
    """Whole numbers in the order of floats."""
    bits = (values + values.dtype.type(0)).view(kind)  # -0 becomes 0
    sign = kind.type(1 << (8 * kind.itemsize - 1))
    return np.where(bits & sign, ~bits, bits | sign)


def _floats(keys: NDArray[np.unsignedinteger], kind: np.dtype[np.floating]) -> FloatArray:
    """Return the floats of `_keys`."""
    sign = keys.dtype.type(1 << (8 * keys.dtype.itemsize - 1))
    return np.where(keys & sign, keys ^ sign, ~keys).view(kind)
