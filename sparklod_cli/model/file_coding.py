"""Codings of the scales in a file, from which the numbers that another reader decodes follow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

#: Coding of scales: "spz", or one of RAD's "ln_0r8" and "ln_f16"; empty for plain numbers, which all readers decode
#: alike. Then the ends of the range of the logarithms, where the codes have one; else 0.
ScaleCoding = tuple[str, float, float]

#: That of plain numbers, and that of SPZ.
PLAIN_SCALES: ScaleCoding = ("", 0.0, 0.0)
SPZ_SCALES: ScaleCoding = ("spz", 0.0, 0.0)


@dataclass(frozen=True)
class FileCoding:
    """Codings of the scales in a file.

    Attributes:
        scales: of each run of splats, in order.
        run: splats of each run but the last.
        packed_range: ends of the range of logarithms in which Spark packs the scales of the file as PackedSplats, where
            the file sets one (RAD's "splatEncoding"); None for Spark's own.
    """

    scales: tuple[ScaleCoding, ...] = (PLAIN_SCALES,)
    run: int = 1
    packed_range: tuple[float, float] | None = None

    def parts(self, count: int) -> Iterator[tuple[slice, ScaleCoding]]:
        """Return the rows of `count` splats, as few slices as their codings allow."""
        start = 0
        for number, coding in enumerate(self.scales):
            last = number + 1 == len(self.scales)
            if last or self.scales[number + 1] != coding:
                stop = count if last else min((number + 1) * self.run, count)
                yield slice(start, stop), coding
                start = stop
