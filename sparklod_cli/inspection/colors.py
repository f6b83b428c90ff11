"""What the colours of splats mean: their level, chunk, opacity or size."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..gaussian import lod_opacity, spark_size
from ..render.colors import CLIPPED, MAGMA, PLASMA, Coloring, Mark, range_of, smooth, whole_numbers
from ..render.shapes import ticks
from ..splats import FloatArray, Splats
from .tree import CHUNK_SPLATS

#: The least span of the scale of sizes, in powers of ten.
LEAST_DECADES = 0.1


def color_by(by: str, splats: Splats, index: NDArray[np.int64], depth: NDArray[np.int32] | None) -> Coloring:
    """The colours of some splats.

    Args:
        by: "level", which wants a depth, "opacity", "size" or "chunk".
        splats: N of them.
        index: (M,) of those that are coloured; at least one.
        depth: (N,) edges from the root, where there is a tree.
    """
    if by == "level" and depth is not None:
        level = depth[index]
        if level.min() == level.max():  # the colour tells where in the tree it is
            return whole_numbers("level", level, 0, int(depth.max()))
        return whole_numbers("level", level, *range_of(level))
    if by == "chunk":
        chunk = index // CHUNK_SPLATS
        return whole_numbers("chunk", chunk, 0, (len(splats) - 1) // CHUNK_SPLATS)
    if by == "opacity":
        return _opacity(lod_opacity(np.maximum(splats.opacity[index], 0)))
    return _size(np.clip(spark_size(splats)[index], 1e-30, 1e30))


def _opacity(values: FloatArray) -> Coloring:
    top = max(1.0, math.ceil(10 * float(np.percentile(values, 100 - CLIPPED))) / 10)
    marks = [(tick / top, text) for tick, text in ticks(0, top, top / 6)]
    if values.max() > top:
        marks = _with_ends(marks, None, f"{top:g} or more")
    return smooth("opacity" if values.max() <= 1 else "opacity (D)", values / top, MAGMA, marks)


def _size(values: FloatArray) -> Coloring:
    logs = np.log10(values.astype(np.float64))
    low, high = np.percentile(logs, [CLIPPED, 100 - CLIPPED])
    if high - low < LEAST_DECADES:  # as good as all the same: no more contrast than there is
        low, high = (low + high - LEAST_DECADES) / 2, (low + high + LEAST_DECADES) / 2
    factors = (1,) if high - low > 2.5 else (1, 2, 5) if high - low > 0.8 else (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(low), math.ceil(high) + 1)
    every = [math.log10(factor) + decade for decade in decades for factor in factors]
    marks = [((at - low) / (high - low), f"{10**at:.3g}") for at in every if low <= at <= high]
    less = f"{10**low:.2g} or less" if logs.min() < low else None
    more = f"{10**high:.2g} or more" if logs.max() > high else None
    return smooth("feature size", (logs - low) / (high - low), PLASMA, _with_ends(marks, less, more))


def _with_ends(marks: list[Mark], low: str | None, high: str | None) -> list[Mark]:
    """The marks of a scale with those of its ends, and without those that would touch them."""
    ends = [(place, text) for place, text in ((0.0, low), (1.0, high)) if text is not None]
    return [mark for mark in marks if all(abs(mark[0] - place) > 0.04 for place, _ in ends)] + ends
