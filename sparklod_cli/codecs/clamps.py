"""Values beyond the ranges of a format's codes, which writing clamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray, Splats
from ..support.parallel import blocks_of, ordered_map
from . import quantize


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
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float
    degree: int = 0
    both: bool = False


@dataclass(frozen=True)
class Clamps:
    """The values of a scene that writing clamps.

    Attributes:
        splats: number of splats with a value beyond either end, by column of `Splats`; without zeros.
        ends: the ends of ranges beyond which values lie.
    """

    splats: dict[str, int] = field(default_factory=dict)
    ends: tuple[Clamp, ...] = ()


def find(splats: Splats, threads: int = 1, ranges: Sequence[Range] = SPZ) -> Clamps:
    """The values of splats that lie beyond ranges, in the order of the ranges."""
    counts: dict[str, int] = {}
    ends = []
    for name in dict.fromkeys(each.column for each in ranges):
        rows = [each for each in ranges if each.column == name]
        column = getattr(splats, name).reshape(len(splats), -1)
        if not column.size:
            continue

        def look(part: slice, column: FloatArray = column, rows: Sequence[Range] = rows) -> list[tuple[float, ...]]:
            found, either = [], np.zeros(part.stop - part.start, np.bool_)
            for each in rows:
                values = column[part, slice(*each.numbers)]
                if each.zero:
                    values = np.where(values < each.zero, each.low, values)
                below, above = _rows_with(values < each.low), _rows_with(values > each.high)
                either |= below | above
                counted = (int(np.count_nonzero(mask)) for mask in (below, above, below | above))
                found.append((*counted, float(values.min()), float(values.max())))
            return [(int(np.count_nonzero(either)),), *found]

        parts = list(ordered_map(look, blocks_of(len(splats)), threads))
        if total := sum(int(part[0][0]) for part in parts):
            counts[name] = total
        for index, each in enumerate(rows, 1):
            below, above, beyond, least, most = zip(*(part[index] for part in parts), strict=True)
            if each.low == -each.high:
                if sum(beyond):
                    farthest = max(-min(least), max(most))
                    ends.append(Clamp(name, True, int(sum(beyond)), each.high, farthest, each.degree, both=True))
                continue
            if sum(below):
                ends.append(Clamp(name, False, int(sum(below)), each.low, min(least), each.degree))
            if sum(above):
                ends.append(Clamp(name, True, int(sum(above)), each.high, max(most), each.degree))
    return Clamps(counts, tuple(ends))


def _rows_with(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which rows of an (N, K) mask have a true value. Few do: one by one, this is five times as fast as `any`."""
    rows = np.zeros(len(mask), np.bool_)
    rows[np.flatnonzero(mask) // mask.shape[1]] = True
    return rows
