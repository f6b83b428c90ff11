"""Pruning of a binary tree: the steps of `kernels/prune.py`, one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN
from ..model.splats import FloatArray
from .kernels import prune
from .kernels.sort import Nodes


def fill_usefulness_terms(
    children: NDArray[np.uint32],
    leaves: int,
    drawn_leaves: int,
    top: int,
    log_size: FloatArray,
    lost: FloatArray,
    weight: FloatArray,
    blocks: int,
) -> Nodes:
    """Fill the terms of `prune.usefulness`.

    Args:
        children: (T - leaves, 2) uint32 of merged nodes; parents come after their children, and the root is last.
        leaves: number of leaves; they come first, and have no place in arrays of merged nodes.
        drawn_leaves: number of splats of the scene under them.
        top: the root. T - 1, or T if nodes without a parent are to get one later, which is that root until then.
        log_size: (top + 1,) float32 feature sizes, replaced by ln(size), but no more than the parent's: the threshold
            above which the traversal does not refine the node.
        lost: (top + 1 - leaves,) float32, `picture_error`, replaced by the error cost of merged nodes, in splats.
        weight: (top + 1 - leaves,) float32, filled for merged nodes with their rarity weight.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.

    Returns:
        (top + 1,) uint32 parents; the root's is itself.
    """
    parent = np.full(top + 1, top, np.uint32)
    steps = prune.STEPS * prune.OCTAVES
    step_of, inner, sums = np.empty(len(children), np.uint16), np.zeros(steps, np.int64), np.zeros(steps)
    prune.link(children, leaves, lost, parent, log_size, step_of, inner, sums)
    counts = np.zeros((blocks, steps), np.int64)
    prune.count_leaves(blocks, leaves, parent, log_size, counts)
    # Roughly the splats of a cut whose threshold is the step.
    drawn = np.cumsum((counts.sum(axis=0) + inner)[::-1])[::-1]
    # Python's powers, because numpy rounds differently on some processors.
    common = np.array([max(min(count, drawn_leaves), 1) ** -prune.RARITY for count in drawn.tolist()])
    rare = np.minimum(drawn / (prune.FEW * drawn_leaves), 1)
    mean = np.divide(sums, inner, out=np.zeros(steps), where=inner > 0)
    prune.fill_terms(len(children), step_of, common, rare, mean, lost, weight)
    return parent


def drop_nodes(
    leaves: int,
    most: int,
    parent: Nodes,
    log_size: FloatArray,
    lost: FloatArray,
    weight: FloatArray,
    saved: NDArray[np.int32],
    blocks: int,
) -> None:
    """Drop the least useful merged nodes until `most` are left, or none can be dropped.

    Args:
        leaves: number of leaves; they come first, and have no place in arrays of merged nodes.
        most: number of merged nodes to keep, at least 1, the root.
        parent: (T,) uint32, updated for what is kept: the nearest ancestor that is kept.
        log_size, lost, weight: of `fill_usefulness_terms`; the error cost of a dropped node is added to its parent's.
        saved: (T - leaves,) int32, on entry 1 for each merged node; what is less for the root allows it that many more
            children. Updated: the number of children minus 1 of those that are kept, -1 for dropped nodes.
        blocks: ranges of nodes to process in parallel; the result does not depend on it.
    """
    slots = len(saved) - 1
    # Merged nodes but the root, less `leaves`, parents first.
    kept = np.arange(slots - 1, -1, -1, dtype=np.uint32)
    keys = np.empty(slots, np.uint16)
    turn, children = prune.ROUNDS, prune.MOST_CHILDREN
    while len(kept) + 1 > most:  # also after ROUNDS, where nodes gained usefulness as their children were dropped
        counts = np.zeros((blocks, 1 << prune.KEY_BITS), np.int32)
        prune.count_by_key(blocks, kept, leaves, children, log_size, lost, weight, saved, parent, keys, counts)
        below = np.cumsum(counts.sum(axis=0))
        if below[-1] == 0:
            if children == MAX_CHILDREN:
                break
            children = min(2 * children, MAX_CHILDREN)
            continue
        spare = len(kept) + 1 - most
        threshold = int(np.searchsorted(below, min(max(spare // turn, 1), below[-1])))
        dropped = prune.drop_below(
            threshold, spare, leaves, children, parent, log_size, weight, kept, keys, lost, saved
        )
        kept = kept[dropped:]
        turn = max(turn - 1, 1)
    prune.skip_dropped(len(parent), leaves, saved, parent)
