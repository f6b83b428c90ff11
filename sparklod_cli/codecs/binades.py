"""`Binades`: how many values lie between one power of two and the next, in very little memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray

#: Where the binades of float32 begin, those of subnormal numbers, too; what is below the first is 0. Last is infinity.
ENDS = np.append(np.ldexp(np.float32(1), np.arange(-149, 128)), np.float32(np.inf))

#: Values that are sorted at a time.
_ROWS = 1 << 18


@dataclass(frozen=True, eq=False)
class Binades:
    """Counts of values of at least 0, by binade: the range from a power of two to the next.

    Attributes:
        count: (binades,) int64: of 0, then of each binade, then of infinity.
        least, most: (binades,) float64 smallest and largest value of each; infinity and 0 of empty ones.
        unknown: the number of values that are not a number.
    """

    count: NDArray[np.int64]
    least: NDArray[np.float64]
    most: NDArray[np.float64]
    unknown: int = 0

    @classmethod
    def of(cls, values: FloatArray) -> Binades:
        """Counts (N,) float32 values of at least 0."""
        parts = [cls._of_sorted(np.sort(values[start : start + _ROWS])) for start in range(0, len(values), _ROWS)]
        return cls.merged(parts) if parts else cls._of_sorted(values)

    @classmethod
    def _of_sorted(cls, values: FloatArray) -> Binades:
        known = len(values) - int(np.count_nonzero(np.isnan(values)))  # which are last
        at = np.concatenate([[0], np.searchsorted(values[:known], ENDS), [known]])
        count = np.diff(at)
        least, most = np.full(len(count), np.inf), np.zeros(len(count))
        filled = np.flatnonzero(count)
        least[filled], most[filled] = values[at[filled]], values[at[filled + 1] - 1]
        return cls(count, least, most, len(values) - known)

    @classmethod
    def merged(cls, parts: Sequence[Binades]) -> Binades:
        """Those of all values of one part or more, in any order."""
        return cls(
            np.sum([part.count for part in parts], axis=0),
            np.min([part.least for part in parts], axis=0),
            np.max([part.most for part in parts], axis=0),
            sum(part.unknown for part in parts),
        )

    def quantile(self, share: float) -> float:
        """A value of the same binade as the quantile of all values, linearly interpolated as numpy does.

        It is the quantile itself where the values on either side of it lie in two binades. Infinity where a value
        is not a number; 0 of no values.
        """
        if self.unknown:
            return float("inf")
        total = int(self.count.sum())
        if not total:
            return 0.0
        place = share * (total - 1)
        rank = int(place)
        until = np.cumsum(self.count)
        first, second = np.searchsorted(until, [rank, min(rank + 1, total - 1)], side="right")
        if first == second:
            return float(self.least[first])
        low, high = float(self.most[first]), float(self.least[second])
        return low + (high - low) * (place - rank)
