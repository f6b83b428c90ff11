"""Which values SPZ cannot hold, at which end of its codes, and how far they are beyond."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

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


def clamped(splats: Splats, threads: int = 1) -> dict[str, int]:
    """How many splats have a value that its code cannot hold, by the column (scale, rgb, sh) where there are any."""
    counts = {}
    for name, (low, high) in quantize.CLAMPS.items():
        column = getattr(splats, name).reshape(len(splats), -1)

        def outside(part: slice, column: FloatArray = column, low: float = low, high: float = high) -> int:
            values = column[part]
            return int(np.count_nonzero(((values < low) | (values > high)).any(axis=1)))

        counts[name] = sum(ordered_map(outside, chunks_of(len(splats)), threads))
    return {name: count for name, count in counts.items() if count}


def clamps(splats: Splats, columns: Iterable[str]) -> list[Clamp]:
    """Which ends of their codes values lie beyond.

    Args:
        splats: as they are written.
        columns: of `Splats`, those that `clamped` found some in.
    """
    found = []
    for name in columns:
        values = getattr(splats, name).reshape(len(splats), -1)
        least, most = values.min(axis=1), values.max(axis=1)
        low, high = quantize.CLAMPS[name]
        below, above = int(np.count_nonzero(least < low)), int(np.count_nonzero(most > high))
        if below:
            found.append(Clamp(name, False, below, low, float(least.min())))
        if above:
            found.append(Clamp(name, True, above, high, float(most.max())))
    return found
