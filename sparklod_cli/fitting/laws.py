"""What fitted nodes must keep: the law of sizes, and that no budget loses on the held-out cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..lod.kernels.tree_links import add_child_sizes, find_parents
from ..model.gaussian import linear_opacity
from ..model.splats import FloatArray
from .held_out import Scores, scores_of
from .kernels.adam import Columns
from .nodes import FittedNodes, Index
from .pictures import Picture
from .settings import SHARES

#: Least feature size of a node, over the mean of its children's, weighted by opacity times surface. `inspect --check`
#: warns below a third, also after rounding to the steps of a format.
LEAST_RATIO = 0.38

#: Times that half of what was changed is taken back, before all is.
HALVES = 12


def keep_sizes(nodes: FittedNodes) -> bool:
    """Gives nodes that became too small for their children their first values, unless they were so at first.

    A parent is refined before its children if it is larger; a small one is drawn in their place for too long
    (docs/decisions/2026-11-21-sizes-of-parents.md).

    Returns:
        whether there were any.
    """
    parent, _ = find_parents(nodes.tree.child_count, nodes.tree.child_start)
    at_first = _ratios(nodes.old, nodes, parent)
    restored = np.zeros(len(parent), np.bool_)
    while True:
        small = _ratios(nodes.columns, nodes, parent) < np.minimum(LEAST_RATIO, at_first)
        if not small.any():
            break
        # Where the node itself has its first values already, its children have grown.
        grown = np.flatnonzero((parent >= 0) & (small & restored)[parent] & ~nodes.tree.is_leaf)
        back = np.union1d(np.flatnonzero(small & ~restored), grown)
        back = back[~restored[back]]
        if not back.size:
            break
        restored[back] = True
        nodes.restore(back)
    return bool(restored.any())


def _ratios(columns: Columns, nodes: FittedNodes, parent: Index) -> FloatArray:
    """(N,) feature size of each node over the mean of its children's; infinite for leaves."""
    every = np.arange(len(parent))
    size, sums, weights = nodes.sizes(every, columns), np.zeros(len(parent)), np.zeros(len(parent))
    add_child_sizes(parent, size, columns.scale, linear_opacity(columns.lod_opacity), sums, weights)
    return np.divide(size * weights, sums, out=np.full(len(parent), np.inf), where=sums > 0)


def keep_gains(nodes: FittedNodes, held_out: Sequence[Picture], before: Scores) -> Scores:
    """Takes back half of what was changed of the nodes that cuts of a share draw, while one lost; returns the scores.

    Args:
        nodes: after the last step.
        held_out: pictures of full detail.
        before: scores of the nodes at first.
    """
    for _ in range(HALVES):
        now = scores_of(nodes, held_out)
        worst = min(SHARES, key=lambda share: now[share] - before[share])
        if not now[worst] < before[worst]:
            return now
        drawn = [nodes.cut(picture.camera, worst) for picture in held_out]
        nodes.halve(np.intersect1d(np.unique(np.concatenate(drawn)), nodes.merged))
    nodes.restore(nodes.merged)
    return before
