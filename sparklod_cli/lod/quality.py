"""The quality builder: a binary tree made by merging the cheapest pairs, pruned to its most useful nodes.

1. Leaves join level by level, from small to large. The active nodes are sorted along a Morton curve, and each finds its
   cheapest partner among its neighbours on it. Of the pairs that chose each other, the cheaper half are merged, all at
   once (`kernels/pair_merge.py`). The curve is shifted from round to round, and its seams with it.
2. A merged node covers the union of its two nodes, and is drawn with the opacity profile that has this coverage
   (`kernels/geometry.py`).
3. The binary tree's least useful nodes are dropped (`kernels/prune.py`).

benchmarks/notes/quality-builder.md has the reasons, and the alternatives that were tried.

In stages, the nodes of a region merge level by level, too. Before each level, nodes so close to the region's border
that their best partner may be beyond it are set aside and handed on; they merge at that level in the stage of a larger
region. So trees have no seams along borders. Each stage prunes the nodes that it made, and leaves part of the growth to
the stages above it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import threads_for
from .kernels import pair_merge
from .kernels.sort import Nodes
from .pair_tree import (
    BinaryTree,
    Curve,
    FinalTree,
    Levels,
    PruningGoal,
    in_final_order,
    levels_of,
    lowest_level,
    merge_levels,
)
from .stages import NO_FAMILY, STAGE_BITS, Bounds, Pending, Region, StageFamilies, check
from .tree_settings import DEFAULT_GROWTH, MAX_GROWTH, MIN_GROWTH

#: For each node that a stage hands on, it leaves this many times what the growth allows for a leaf to those above it:
#: more than once, as the pruning of a stage adds to what it hands on. Measured: once loses up to 0.3 dB.
RESERVE = 1.25

#: ln(size in units) of rank 0: larger than any size.
HIGHEST = 128 * math.log(2)

#: Rank of the (missing) children of a leaf: after all others.
LAST = np.iinfo(np.int32).max


def build(splats: Splats, growth: float = DEFAULT_GROWTH, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Build a Level-of-Detail tree whose cuts are close to full detail.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: the children of larger nodes come first, and along a Morton curve within a step of size.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        growth: maximum ratio of nodes to leaves, 1.05 to 2.

    Returns:
        M >= N splats and their tree.

    Raises:
        InvalidSplatsError: there are no splats, or one is invisible.
        ValueError: the growth is out of range.
    """
    _check_growth(growth)
    bounds = check(splats)
    n = len(splats)
    if n == 1:
        return splats, LodTree(np.zeros(1, np.uint16), np.zeros(1, np.uint32))
    curve = Curve.of(splats, bounds)
    with threads_for(n) as threads:
        index = curve.order(splats.center, threads)
        binary = BinaryTree.of_leaves(*curve.leaf_rows(splats, index))
        levels = levels_of(binary.size[:n])
        np.maximum(levels, lowest_level(levels), out=levels)
        merge_levels(binary, levels, curve, None, progress)
        goal = PruningGoal(max(int(growth * n) - n, 1), n)
        columns = dict(vars(splats))
        del splats
        final = in_final_order(binary, index, columns, goal, curve, progress)
        return final.splats, final.tree


def _check_growth(growth: float) -> None:
    if not MIN_GROWTH <= growth <= MAX_GROWTH:
        raise ValueError(f"growth {growth} is not within {MIN_GROWTH} to {MAX_GROWTH}")


@dataclass(frozen=True, eq=False)
class Plan:
    """Parameters that all stages of a build share: maximum ratio of nodes to leaves, curve, first level of merging."""

    growth: float
    curve: Curve
    lowest: int


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Columns of `Pending` besides the splats: sizes, levels and families of pending nodes.

    Attributes:
        rows: (n, WIDTH) float32 node rows.
        size: (n,) float32 feature sizes, units.
        level: (n,) int32 level at which each merges next.
        family: (n,) int64 numbers of their families.
        rank: (n,) int32 batches of their families, LAST for leaves.
        leaves, merged: (n,) int64 numbers of leaves and of merged nodes in their trees; only the sums have a meaning.
    """

    rows: FloatArray
    size: FloatArray
    level: Levels
    family: NDArray[np.int64]
    rank: NDArray[np.int32]
    leaves: NDArray[np.int64]
    merged: NDArray[np.int64]

    @classmethod
    def of(cls, pending: Pending, index: NDArray[np.unsignedinteger], plan: Plan) -> _Nodes:
        """Return the columns of pending nodes; if these are fresh from `leaves`, the columns are those of leaves."""
        columns = pending.columns
        if "rows" in columns:
            return cls(**{field.name: columns[field.name][index] for field in fields(cls)})
        rows, size = plan.curve.leaf_rows(pending.splats, index)
        count = len(index)
        family, rank = np.full(count, NO_FAMILY, np.int64), np.full(count, LAST, np.int32)
        level = np.maximum(levels_of(size), plan.lowest)
        return cls(rows, size, level, family, rank, np.ones(count, np.int64), np.zeros(count, np.int64))

    def pending(self, splats: Splats) -> Pending:
        """Return these nodes with the splats that they are drawn as."""
        return Pending.of(splats, **vars(self))


def plan(bounds: Bounds, sample: Splats, setting: float) -> Plan:
    """See `StagedBuilder`; the setting is the growth, 1.05 to 2."""
    _check_growth(setting)
    curve = Curve.of(sample, bounds)
    _, size = curve.leaf_rows(sample, np.arange(len(sample), dtype=np.uint32))
    return Plan(setting, curve, lowest_level(levels_of(size)))


def leaves(splats: Splats, index: NDArray[np.int64], plan: Plan) -> Pending:
    """See `StagedBuilder`."""
    return Pending.of(splats)


def advance(
    pending: Pending, region: Region | None, stage: int, plan: Plan, *, progress: Progress
) -> tuple[StageFamilies, Pending]:
    """See `StagedBuilder`."""
    splats, count = pending.splats, len(pending)
    if count <= 1:
        everything = np.arange(count, dtype=np.uint32)
        none = splats.take(slice(0, 0))
        empty = np.empty(0, np.int32), np.empty((0, 1), np.uint64), np.empty(0, np.uint16)
        families = StageFamilies(*empty, none, np.empty(0, np.int64), none.center, none.opacity)
        return families, _Nodes.of(pending, everything, plan).pending(splats)
    curve = plan.curve.around(splats.center)
    with threads_for(count) as threads:
        index = curve.order(splats.center, threads)
        nodes = _Nodes.of(pending, index, plan)
        binary = BinaryTree.of_leaves(nodes.rows, nodes.size)
        nodes = replace(nodes, rows=np.empty((0, pair_merge.WIDTH), np.float32))  # the tree writes over them
        left = merge_levels(binary, nodes.level, curve, region, progress)
        goal = _pruning_goal(nodes, len(left[0]), region, plan)
        final = in_final_order(binary, index, dict(vars(splats)), goal, plan.curve, progress)
    numbers = np.full(len(final.order), NO_FAMILY, np.int64)
    is_leaf = final.order < count
    numbers[is_leaf] = nodes.family[final.order[is_leaf]]
    numbers[final.parents] = (stage << STAGE_BITS) | np.arange(len(final.parents))
    families = _families(final, numbers)
    if region is None:
        return families, Pending.of(final.splats.take(slice(1)), family=numbers[:1])
    sums = int(nodes.leaves.sum()), int(nodes.merged.sum()) + len(final.parents)
    return families, _rest(final, pending, index, left, numbers, sums, plan)


def _pruning_goal(nodes: _Nodes, handed: int, region: Region | None, plan: Plan) -> PruningGoal:
    """Return the goal of a stage that hands on `handed` nodes."""
    splats = int(nodes.leaves.sum())
    most = int(plan.growth * splats) - splats - int(nodes.merged.sum())
    if region is None:
        one_stage = bool((nodes.family == NO_FAMILY).all())  # then the tree is that of `quality.build`
        return PruningGoal(max(most, 1), splats, highest=None if one_stage else HIGHEST, latest=nodes.rank)
    reserve = max(1, math.ceil(min(RESERVE * (plan.growth - 1), 1) * handed))
    return PruningGoal(max(most - reserve, 0), splats, False, HIGHEST, nodes.rank)


def _families(final: FinalTree, numbers: NDArray[np.int64]) -> StageFamilies:
    """Return the families of the nodes that a stage kept; `numbers` are those of all nodes' families."""
    children = slice(final.first_child, None)
    nodes, parents = final.splats.take(children), final.splats.take(final.parents)
    count, size = final.tree.child_count[final.parents], spark_size(parents)
    return StageFamilies(final.ranks, final.keys[:, None], count, nodes, numbers[children], parents.center, size)


def _rest(
    final: FinalTree,
    pending: Pending,
    index: Nodes,
    left: tuple[Nodes, Levels],
    numbers: NDArray[np.int64],
    sums: tuple[int, int],
    plan: Plan,
) -> Pending:
    """Return the nodes that a stage hands on: those without a parent, which come right after the first.

    Args:
        index: (n,) places of the tree's leaves in `pending`.
        left: nodes without a parent before the tree was pruned, and the levels at which they merge next.
        numbers: (M,) of the families of the nodes of `final`.
        sums: numbers of leaves and of merged nodes under all nodes that are handed on.
    """
    here = slice(1, final.first_child)
    splats, node, family = final.splats.take(here), final.order[here], numbers[here]
    merged = node >= len(index)
    nodes = _Nodes.of(pending, index[np.where(merged, 0, node)], plan)
    own = family[merged] & ((1 << STAGE_BITS) - 1)
    nodes.rows[merged], nodes.rank[merged] = final.rows[own], final.ranks[own]
    nodes.size[merged] = spark_size(splats)[merged] / plan.curve.unit
    # A node whose parent was pruned merges again at the level of its size.
    nodes.level[:] = np.maximum(levels_of(nodes.size), plan.lowest)
    by_node = np.argsort(left[0])
    at = np.minimum(np.searchsorted(left[0], node, sorter=by_node), len(by_node) - 1)
    known = left[0][by_node[at]] == node
    nodes.level[known] = left[1][by_node[at]][known]
    nodes.leaves[:], nodes.merged[:] = 0, 0
    nodes.leaves[:1], nodes.merged[:1] = sums
    return replace(nodes, family=family).pending(splats)
