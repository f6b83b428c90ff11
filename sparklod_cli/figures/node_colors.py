"""Colours of nodes by depth, chunk, opacity or size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import lod_opacity, spark_size
from ..model.nodes import CHUNK_NODES
from ..model.splats import FloatArray, Splats
from ..render.color_scales import (
    MAGMA,
    PLASMA,
    Coloring,
    log_marks,
    log_range,
    range_of,
    smooth,
    ticks,
    top_opacity,
    whole_numbers,
    with_ends,
)

#: Marks closer to an end of a scale than this share of it are left out: they would touch the mark of the end.
APART = 0.04


def color_by(by: str, splats: Splats, index: NDArray[np.int64], depth: NDArray[np.int32] | None) -> Coloring:
    """The colours of M of N splats, and the scale that explains them.

    Args:
        by: one of `PLOT_BY`: "level", the depth of a node, needs `depth`; else "opacity", "size" or "chunk".
        splats: all N splats.
        index: (M,) indices of the splats that are coloured; at least one.
        depth: (N,) edges from the root; None for a scene without a tree.
    """
    if by == "level" and depth is not None:
        chosen = depth[index]
        if chosen.min() == chosen.max():  # one depth alone: its colour says how far down the tree it lies
            return whole_numbers("tree depth", chosen, 0, int(depth.max()))
        return whole_numbers("tree depth", chosen, *range_of(chosen))
    if by == "chunk":
        chunk = index // CHUNK_NODES
        return whole_numbers("chunk", chunk, 0, (len(splats) - 1) // CHUNK_NODES)
    if by == "opacity":
        return _opacity(lod_opacity(np.maximum(splats.opacity[index], 0)))
    return _size(np.clip(spark_size(splats)[index], 1e-30, 1e30))


def _opacity(values: FloatArray) -> Coloring:
    top = top_opacity(values)
    marks = [(tick / top, text) for tick, text in ticks(0, top, top / 6)]
    if values.max() > top:
        marks = with_ends(marks, None, f"{top:g} or more", APART)
    return smooth("opacity" if values.max() <= 1 else "opacity (D)", values / top, MAGMA, marks)


def _size(values: FloatArray) -> Coloring:
    logs = np.log10(values.astype(np.float64))
    low, high = log_range(logs)
    marks = log_marks(low, high)
    less = f"{10**low:.2g} or less" if logs.min() < low else None
    more = f"{10**high:.2g} or more" if logs.max() > high else None
    return smooth("feature size", (logs - low) / (high - low), PLASMA, with_ends(marks, less, more, APART))
