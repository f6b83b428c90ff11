"""Values beyond the ranges of SPZ's codes, which writing clamps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..model.splats import FloatArray, Splats
from ..support.parallel import blocks_of, ordered_map
from . import quantize


@dataclass(frozen=True)
class Clamp:
    """Values of a column that lie beyond one end of the range of their code.

    Attributes:
        column: of `Splats`: scale, rgb or sh.
        above: whether they lie above the upper end; otherwise below the lower one.
        splats: number of splats with such a value.
        end: the end of the range.
        farthest: the value farthest beyond the end.
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float


@dataclass(frozen=True)
class Clamps:
    """The values of a scene that writing clamps.

    Attributes:
        splats: number of splats with a value beyond either end, by column of `Splats`; without zeros.
        ends: the ends of ranges beyond which values lie.
    """

    splats: dict[str, int] = field(default_factory=dict)
    ends: tuple[Clamp, ...] = ()


def find(splats: Splats, threads: int = 1) -> Clamps:
    """The values of splats that lie beyond the ranges of SPZ."""
    counts, ends = {}, []
    for name, (low, high) in quantize.CLAMPS.items():
        column = getattr(splats, name).reshape(len(splats), -1)
        if not column.size:
            continue

        def look(part: slice, column: FloatArray = column, low: float = low, high: float = high) -> tuple[float, ...]:
            least, most = column[part].min(axis=1), column[part].max(axis=1)
            below, above = least < low, most > high
            counted = (int(np.count_nonzero(mask)) for mask in (below | above, below, above))
            return *counted, float(least.min()), float(most.max())

        either, below, above, least, most = zip(*ordered_map(look, blocks_of(len(splats)), threads), strict=True)
        if sum(either):
            counts[name] = int(sum(either))
        if sum(below):
            ends.append(Clamp(name, False, int(sum(below)), low, min(least)))
        if sum(above):
            ends.append(Clamp(name, True, int(sum(above)), high, max(most)))
    return Clamps(counts, tuple(ends))
