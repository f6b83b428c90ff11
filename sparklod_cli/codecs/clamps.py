"""Which values SPZ cannot hold, at which end of its codes, and how far they are beyond."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..model.splats import FloatArray, Splats
from ..support.parallel import chunks_of, ordered_map
from . import quantize


@dataclass(frozen=True)
class Clamp:
    """Values that become an end of what their code holds.

    Attributes:
        column: of `Splats`: scale, rgb or sh.
        above: they lie above the upper end, else below the lower one.
        splats: how many have such a value.
        end: what they lie beyond.
        farthest: the value that is farthest from there.
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float


@dataclass(frozen=True)
class Clamps:
    """What a file cannot hold.

    Attributes:
        splats: by the column of `Splats`, how many have a value beyond either end; columns without any are left out.
        ends: the ends that values lie beyond.
    """

    splats: dict[str, int] = field(default_factory=dict)
    ends: tuple[Clamp, ...] = ()


def find(splats: Splats, threads: int = 1) -> Clamps:
    """What SPZ cannot hold of splats."""
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

        either, below, above, least, most = zip(*ordered_map(look, chunks_of(len(splats)), threads), strict=True)
        if sum(either):
            counts[name] = int(sum(either))
        if sum(below):
            ends.append(Clamp(name, False, int(sum(below)), low, min(least)))
        if sum(above):
            ends.append(Clamp(name, True, int(sum(above)), high, max(most)))
    return Clamps(counts, tuple(ends))
