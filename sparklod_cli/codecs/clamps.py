"""Values beyond the ranges of a format's codes, which writing clamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..model.splats import Splats
from ..support.parallel import blocks_of, ordered_map
from . import quantize
from .encoder import rows_of


@dataclass(frozen=True)
class Range:
    """Values of a column that a format holds without clamping them.

    Attributes:
        column: of `Splats`.
        low, high: smallest and largest value that is rounded to a code.
        numbers: the first, and the one after the last, of the numbers of a splat that are meant; all by default.
        zero: values below this are held as 0.
        degree: of the SH that they are; 0 for other columns, or for SH of all degrees.
    """

    column: str
    low: float
    high: float
    numbers: tuple[int, int | None] = (0, None)
    zero: float = 0.0
    degree: int = 0


#: What SPZ holds.
SPZ = tuple(Range(column, low, high) for column, (low, high) in quantize.CLAMPS.items())


#: Shares of the smallest value of a range: what lies below these, too, is counted.
DEEPER = (1e-1, 1e-2, 1e-3, 1e-4)

#: Share of splats with a scale below their range from which on a scene is too small for a format, rather than a few of
#: its splats too thin.
MANY = 0.01

#: Counts of what lies beyond ranges, see `tally`.
Tally = NDArray[np.float64]


@dataclass(frozen=True)
class Clamp:
    """Values of a column that lie beyond one end of the range of their code, or both of a range around 0.

    Attributes:
        column: of `Splats`: center, scale, rgb or sh.
        above: whether they lie above the upper end; otherwise below the lower one.
        splats: number of splats with such a value.
        end: the end of the range.
        farthest: the value farthest beyond the end.
        degree: as in `Range`.
        both: the range is -end to end; the values lie beyond either, and `farthest` is a magnitude.
        deeper: number of splats with such a value below each of `DEEPER` of a lower end above 0.
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float
    degree: int = 0
    both: bool = False
    deeper: tuple[int, ...] = ()

    def multiple(self, splats: int) -> int | None:
        """The least power of ten by which a scene has to grow to have few values below a lower end; None if more than
        `DEEPER` has is needed.

        Args:
            splats: of the scene.
        """
        fitting = (round(1 / share) for share, left in zip(DEEPER, self.deeper, strict=True) if left <= MANY * splats)
        return next(fitting, None)


@dataclass(frozen=True)
class Clamps:
    """The values of a scene that writing clamps.

    Attributes:
        splats: number of splats with a value beyond either end, by column of `Splats`; without zeros.
        ends: the ends of ranges beyond which values lie.
    """

    splats: dict[str, int] = field(default_factory=dict)
    ends: tuple[Clamp, ...] = ()


def tally(splats: Splats, ranges: Sequence[Range]) -> Tally:
    """What lies beyond ranges among some splats of a file.

    Args:
        splats: n of them.
        ranges: those of one column are side by side.

    Returns:
        (ranges, 6 + deeper) float64: splats below the range, above, and either; splats beyond any range of its column;
        the least and the largest value, infinite where there is none; splats below each of `DEEPER` of the range.
    """
    found = np.zeros((len(ranges), 6 + len(DEEPER)))
    found[:, 4:6] = np.inf, -np.inf
    for name in dict.fromkeys(each.column for each in ranges):
        column, either = getattr(splats, name).reshape(len(splats), -1), np.zeros(len(splats), np.bool_)
        numbers = [number for number, each in enumerate(ranges) if each.column == name]
        for number in numbers:
            each = ranges[number]
            values = column[:, slice(*each.numbers)]
            if not values.size:
                continue
            if each.zero:
                values = np.where(values < each.zero, each.low, values)
            below, above = _rows_with(values < each.low), _rows_with(values > each.high)
            either |= below | above
            counts = (np.count_nonzero(mask) for mask in (below, above, below | above))
            found[number, :6] = (*counts, 0, values.min(), values.max())
            if each.low > 0 and below.any():
                least = values[below].min(axis=1)
                found[number, 6:] = [np.count_nonzero(least < share * each.low) for share in DEEPER]
        found[numbers, 3] = np.count_nonzero(either)
    return found


def merged(tallies: Sequence[Tally]) -> Tally:
    """The tally of all splats of one part or more."""
    parts = np.stack(tallies)
    ends = [parts[:, :, 4].min(axis=0), parts[:, :, 5].max(axis=0)]
    return np.column_stack([parts[:, :, :4].sum(axis=0), *ends, parts[:, :, 6:].sum(axis=0)])


def clamps_of(found: Tally, ranges: Sequence[Range]) -> Clamps:
    """What a tally of these ranges says, in their order."""
    counts: dict[str, int] = {}
    ends = []
    for each, row in zip(ranges, found.tolist(), strict=True):
        below, above, beyond, either, least, most, *deeper = row
        if either:
            counts[each.column] = int(either)
        if each.low == -each.high:
            if beyond:
                farthest = max(-least, most)
                ends.append(Clamp(each.column, True, int(beyond), each.high, farthest, each.degree, both=True))
            continue
        if below:
            found_deeper = tuple(map(int, deeper)) if each.low > 0 else ()
            ends.append(Clamp(each.column, False, int(below), each.low, least, each.degree, deeper=found_deeper))
        if above:
            ends.append(Clamp(each.column, True, int(above), each.high, most, each.degree))
    return Clamps(counts, tuple(ends))


def find(splats: Splats, threads: int = 1, ranges: Sequence[Range] = SPZ) -> Clamps:
    """The values of splats that lie beyond ranges, in the order of the ranges."""
    if not len(splats):
        return Clamps()
    parts = (rows_of(splats, None, part)[0] for part in blocks_of(len(splats)))
    return clamps_of(merged(list(ordered_map(lambda part: tally(part, ranges), parts, threads))), ranges)


def _rows_with(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which rows of an (N, K) mask have a true value. Few do: one by one, this is five times as fast as `any`."""
    rows = np.zeros(len(mask), np.bool_)
    rows[np.flatnonzero(mask) // mask.shape[1]] = True
    return rows
