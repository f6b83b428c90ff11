"""`Magnitudes`: how many values of a column are how large, whatever their order, in little memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

#: A bin has the float32 of the same upper bits: sign, exponent and 7 bits of the mantissa, so its ends are at most
#: 0.8 % apart.
_SHIFT = 16
_BINS = 1 << 15

#: Values that are counted at a time: they and their bins stay in the processor's cache.
_VALUES = 1 << 17


def _of_bins(bins: NDArray[np.uint32]) -> NDArray[np.float64]:
    return (bins << np.uint32(_SHIFT)).view(np.float32).astype(np.float64)


#: Ends of the bins. The last ones are of infinity and NaN.
with np.errstate(invalid="ignore", over="ignore"):
    UPPER = _of_bins(np.arange(1, _BINS + 1, dtype=np.uint32))
    LOWER = _of_bins(np.arange(_BINS, dtype=np.uint32))


@dataclass(frozen=True, eq=False)
class Magnitudes:
    """Counts of positive and of negative values.

    Attributes:
        positive, negative: (bins,) counts by magnitude, ascending; 0 is positive, -0 negative.
        lowest, highest: of all values and 0.
    """

    positive: NDArray[np.int64]
    negative: NDArray[np.int64]
    lowest: float
    highest: float

    @classmethod
    def of(cls, values: FloatArray) -> Magnitudes:
        """Counts all values of (N, ...) float32."""
        counts, lowest, highest = np.zeros(2 * _BINS, np.int64), 0.0, 0.0
        rows = max(1, _VALUES * len(values) // max(values.size, 1))
        for start in range(0, len(values), rows):
            flat = np.ascontiguousarray(values[start : start + rows], np.float32).reshape(-1)
            lowest, highest = min(lowest, float(flat.min(initial=0))), max(highest, float(flat.max(initial=0)))
            counts += np.bincount(flat.view(np.uint32) >> np.uint32(_SHIFT), minlength=2 * _BINS)
        return cls(counts[:_BINS], counts[_BINS:], lowest, highest)

    @classmethod
    def merged(cls, parts: Sequence[Magnitudes]) -> Magnitudes:
        """Those of all values of one part or more, in any order."""
        positive = np.sum([part.positive for part in parts], axis=0)
        negative = np.sum([part.negative for part in parts], axis=0)
        return cls(positive, negative, min(part.lowest for part in parts), max(part.highest for part in parts))

    @property
    def count(self) -> int:
        """Number of values."""
        return int(self.positive.sum() + self.negative.sum())


def tops(counts: NDArray[np.int64], total: int, most: float, beyond: NDArray[np.float64]) -> NDArray[np.float64]:
    """The magnitudes above which lie at most these shares of `total` values; `most` is the largest magnitude."""
    above = np.cumsum(counts[::-1])[::-1]  # of each bin and all larger ones
    first = [int(np.count_nonzero(above > share * total)) for share in beyond]
    return np.minimum([UPPER[each - 1] if each else 0.0 for each in first], most)
