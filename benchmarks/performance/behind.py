"""Where figures fell behind earlier ones by more than noise.

A figure did if the fastest of its runs is slower than the slowest of the earlier ones, and its median by more than
`MARGIN`, after the earlier figures of time were scaled to how fast the machine is now. Of the calibration's figures the
one counts that fell most, at its best moment before and its worst now: what a slower machine may explain is not blamed
on the code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median

from performance.figures import Measured
from performance.rows import Label, Row, Table

#: Figures of the calibration that count. Copies into new memory do not: they differ tenfold from one to the next where
#: a virtual machine's host takes memory back, which would excuse everything.
SPEEDS = ("warm_gb_s", "one_gflop_s", "two_gflop_s")

#: Growth of a median that is no noise, where the ranges of the runs are apart, too. Single runs of the same code
#: differed by up to this.
MARGIN = 1.1

#: The same for figures of one run, which have no range.
MARGIN_OF_ONE = 1.3


@dataclass(frozen=True)
class Behind:
    """A figure that fell behind.

    Attributes:
        key: labels of its row.
        name: of the figure.
        before, now: medians.
        scale: that the machine is slower by.
    """

    key: tuple[Label, ...]
    name: str
    before: float
    now: float
    scale: float

    def __str__(self) -> str:
        row = ", ".join(map(str, self.key))
        slower = "" if self.scale == 1 else f", on a machine up to {self.scale:.2f} times as slow"
        return f"{row}: {self.name} {self.now:.4g}, was {self.before:.4g} ({self.now / self.before:.2f} times{slower})"


def behind(table: Table, before: Measured, now: Measured) -> Iterator[Behind]:
    """Those of a table's judged figures that fell behind; rows that only one of the two has do not count."""
    earlier = {table.key_of(row): row for row in before.rows}
    slower = slowdown(before, now)
    for row in now.rows:
        old = earlier.get(table.key_of(row))
        if old is None:
            continue
        for name in table.judged:
            scale = slower if name.endswith("_s") else 1.0
            found = _compared(old, row, name, scale)
            if found:
                yield Behind(table.key_of(row), name, found[0], found[1], scale)


def _compared(old: Row, new: Row, name: str, scale: float) -> tuple[float, float] | None:
    """The medians, if it fell behind."""
    earlier, runs = old.runs.get(name), new.runs.get(name)
    if not earlier or not runs:
        return None
    margin = MARGIN if min(len(earlier), len(runs)) > 1 else MARGIN_OF_ONE
    apart = min(runs) > scale * max(earlier)
    grown = median(runs) > margin * scale * median(earlier)
    return (median(earlier), median(runs)) if apart and grown else None


def slowdown(before: Measured, now: Measured) -> float:
    """How many times as slow the machine may be now; below 1 if it is faster by every figure that counts."""

    def speeds(section: Measured, name: str) -> list[float]:
        return [calibration.medians()[name] for calibration in (section.before, section.after)]

    return max(max(speeds(before, name)) / min(speeds(now, name)) for name in SPEEDS)
