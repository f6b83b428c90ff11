"""Values of a scene that the codes of a file clamp: their counts, and which of them a person should know of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..model.lod_tree import LodTree
from ..model.splats import Splats
from ..system.threads import blocks_of, ordered_map
from .encoder import SPZ_RANGES, CodeRange, Tally, tally

#: Share of leaves from which on a visible loss of each matters, by column. Measured: with 0.36 % of colours clamped,
#: pictures of meadow change by up to 36 steps of 255 (61 dB); with 2.4 % of SH, those of playbot by up to 7 (71 dB).
MANY = {"scale": 0.001, "rgb": 0.001, "sh": 0.05}


@dataclass(frozen=True)
class Clamp:
    """Values of a column that lie beyond one end of the range of their code, or both of a range around 0.

    Attributes:
        column: of `Splats`: center, scale, rgb or sh.
        above: whether they lie above the upper end; otherwise below the lower one.
        farthest: the value farthest beyond the end.
        degree: as in `CodeRange`.
        both: the range is -end to end; the values lie beyond either, and `farthest` is a magnitude.
        visible: number of leaves whose loss can be seen, see `tally`.
    """

    column: str
    above: bool
    splats: int
    end: float
    farthest: float
    degree: int = 0
    both: bool = False
    visible: int = 0


#: Values of a scene that writing clamps: number of splats by column of `Splats`, and the ends of their ranges.
Clamps = tuple[dict[str, int], tuple[Clamp, ...]]


def clamp_matters(column: str, *, above: bool, visible: int, leaves: int) -> bool:
    """Return whether a person should know of clamped values.

    Splats that move or shrink may be large in a picture, so that one is enough; of others, a share of `MANY`.
    """
    return visible > (0 if column == "center" or (column == "scale" and above) else MANY[column] * leaves)


def clamps_of(tallies: Sequence[Tally], ranges: Sequence[CodeRange]) -> Clamps:
    """Merge the tallies of all parts; in the order of the ranges."""
    if not tallies:
        return {}, ()
    parts = np.stack(tallies)
    ends = parts[:, :, 4].min(axis=0), parts[:, :, 5].max(axis=0)
    found = np.column_stack([parts[:, :, :4].sum(axis=0), *ends, parts[:, :, 6:].sum(axis=0)])
    counts, clamps = dict[str, int](), list[Clamp]()
    for each, row in zip(ranges, found.tolist(), strict=True):
        below, above, beyond, either, least, most, *visible = row
        seen_below, seen_above, seen = map(int, visible)
        if either:
            counts[each.column] = int(either)
        if each.low == -each.high:
            if beyond:
                farthest = max(-least, most)
                clamps.append(Clamp(each.column, True, int(beyond), each.high, farthest, each.degree, True, seen))
            continue
        if below:
            clamps.append(Clamp(each.column, False, int(below), each.low, least, each.degree, visible=seen_below))
        if above:
            clamps.append(Clamp(each.column, True, int(above), each.high, most, each.degree, visible=seen_above))
    return counts, tuple(clamps)


def clamps_in(
    splats: Splats, threads: int = 1, ranges: Sequence[CodeRange] = SPZ_RANGES, tree: LodTree | None = None
) -> Clamps:
    """Find the values of splats, or of the nodes of a tree, that lie beyond ranges, in the order of the ranges."""

    def counted(part: slice) -> Tally:
        return tally(splats.take(part), ranges, None if tree is None else tree.rows(part).is_leaf)

    return clamps_of(list(ordered_map(counted, blocks_of(len(splats)), threads)), ranges)
