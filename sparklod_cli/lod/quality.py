"""The quality builder: a binary tree made by merging the cheapest pairs, pruned to its most useful nodes.

1. Leaves join level by level, from small to large. The active nodes are sorted along a Morton curve, and each finds its
   cheapest partner among its neighbours on it (`kernels/pair_cost.py`). Of the pairs that chose each other, the cheaper
   half are merged, all at once. The curve is shifted from round to round, and its seams with it.
2. A merged node covers the union of its two nodes (`kernels/pair_merge.py`), and is drawn with the opacity profile that
   has this coverage (`kernels/profile.py`).
3. The binary tree's least useful nodes are dropped (`kernels/prune.py`).

docs/decisions/2026-11-21-fidelity.md has the reasons, and the alternatives that were tried.
"""

from __future__ import annotations

import numpy as np

from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..support.defaults import DEFAULT_GROWTH, MAX_GROWTH, MIN_GROWTH
from ..support.jit import threads_for
from ..support.progress import Progress, silent
from .check import check, check_setting
from .pairs.binary import BinaryTree, Levels, levels_of, lowest_level, merge_levels
from .pairs.curve import Curve
from .pairs.final_tree import Wanted, in_final_order


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: the children of larger nodes come first, and along a Morton curve within a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: maximum ratio of nodes to leaves, 1.05 to 2.
        progress: called with the number of nodes done in each of the stages building, pruning and ordering.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there are no splats, or one is invalid or invisible.
        ValueError: the growth is out of range.
    """
    check_setting("growth", growth, MIN_GROWTH, MAX_GROWTH)
    bounds = check(splats)
    n = len(splats)
    if n == 1:
        return splats, LodTree(np.zeros(1, np.uint16), np.zeros(1, np.uint32))
    curve = Curve.of(splats, bounds)
    with threads_for(n) as threads:
        index = curve.order(splats.center, threads)
        binary = BinaryTree.of_leaves(*curve.leaf_rows(splats, index))
        merge_levels(binary, _levels(binary.size[:n]), curve, None, progress)
        wanted = Wanted(max(int(growth * n) - n, 1), n)
        columns = dict(vars(splats))
        del splats
        final = in_final_order(binary, index, columns, wanted, curve, progress)
        return final.splats, final.tree


def _levels(size: FloatArray) -> Levels:
    """(n,) levels that leaves of a size, in units, join at."""
    levels = levels_of(size)
    return np.maximum(levels, lowest_level(levels), out=levels)
