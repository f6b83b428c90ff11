"""`FileCoding`, how a file holds its scales: what it takes to know the numbers that another reader has of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class ScaleCoding:
    """The codes that some scales are decoded from.

    Attributes:
        name: "spz", or one of RAD's "ln_0r8" and "ln_f16"; empty for plain numbers, which all readers have alike.
        low, high: ends of the range of the logarithms, where the codes have one.
    """

    name: str = ""
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True)
class FileCoding:
    """What a file says of its codes.

    Attributes:
        scales: of each run of splats, in order.
        run: splats of each run but the last.
        packed_range: ends of the range of logarithms in which Spark packs the scales of the file as PackedSplats, where
            the file sets one (RAD's "splatEncoding"); None for Spark's own.
    """

    scales: tuple[ScaleCoding, ...]
    run: int
    packed_range: tuple[float, float] | None = None

    def parts(self, count: int) -> Iterator[tuple[slice, ScaleCoding]]:
        """The rows of `count` splats, as few slices as their codings allow."""
        start = 0
        for number, coding in enumerate(self.scales):
            last = number + 1 == len(self.scales)
            if last or self.scales[number + 1] != coding:
                stop = count if last else min((number + 1) * self.run, count)
                yield slice(start, stop), coding
                start = stop


#: That of splats that were not read from codes.
PLAIN = FileCoding((ScaleCoding(),), 1)
