"""The quality builder in stages.

The nodes of a region merge level by level. Before each level, nodes so close to the region's border that their best
partner may be beyond it are set aside; they merge at that level in the stage of a larger region. So trees have no seams
along borders. Each stage prunes the nodes that it made, and leaves part of the growth to later stages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress
from ..system.threads import threads_for
from .bounds import Bounds
from .kernels.pair_merge import WIDTH
from .kernels.sort import Nodes
from .quality import (
    BinaryTree,
    Curve,
    FinalTree,
    Levels,
    PruningGoal,
    check_growth,
    in_final_order,
    levels_of,
    lowest_level,
    merge_levels,
)
from .stages import NO_FAMILY, STAGE_BITS, Pending, Region, StageFamilies, drawn_splats

#: Growth that a stage leaves to later ones for each pending node, as a multiple of the growth for a leaf: more than 1,
#: as its pruning leaves more nodes pending. Measured: 1 loses up to 0.3 dB.
RESERVE = 1.25

#: ln(size in units) of rank 0: larger than any size.
HIGHEST = 128 * math.log(2)

#: Rank of the (missing) children of a leaf: after all others.
LAST = np.iinfo(np.int32).max


@dataclass(frozen=True, eq=False)
class Plan:
    """Parameters that all stages of a build share: maximum ratio of nodes to leaves, curve, first level of merging."""

    growth: float
    curve: Curve
    lowest: int


@dataclass(frozen=True, eq=False)
class _Columns:
    """Columns of pending nodes besides the splats.

    Attributes:
        rows: (n, WIDTH) float32 node rows.
        size: (n,) float32 feature sizes, units.
        level: (n,) int32 level at which each merges next.
        family: (n,) int64 number of its family.
        rank: (n,) int32 batch of its family, LAST for a leaf.
        leaves, merged: (n,) int64 counts whose sums are the leaves and merged nodes under all nodes of a stage.
    """

    rows: FloatArray
    size: FloatArray
    level: Levels
    family: NDArray[np.int64]
    rank: NDArray[np.int32]
    leaves: NDArray[np.int64]
    merged: NDArray[np.int64]

    @classmethod
    def of(cls, pending: Pending, index: NDArray[np.unsignedinteger], plan: Plan) -> _Columns:
        """Return the columns of pending nodes, computed for nodes fresh from `leaves`."""
        if "rows" in pending:
            return cls(**{field.name: pending[field.name][index] for field in fields(cls)})
        rows, size = plan.curve.leaf_rows(drawn_splats(pending), index)
        count = len(index)
        family, rank = np.full(count, NO_FAMILY, np.int64), np.full(count, LAST, np.int32)
        level = np.maximum(levels_of(size), plan.lowest)
        return cls(rows, size, level, family, rank, np.ones(count, np.int64), np.zeros(count, np.int64))


def plan(bounds: Bounds, sample: Splats, setting: float) -> Plan:
    """Return the parameters of all stages; see `StagedBuilder.plan`. The setting is the growth, 1.05 to 2."""
    check_growth(setting)
    curve = Curve.of(sample, bounds)
    _, size = curve.leaf_rows(sample, np.arange(len(sample), dtype=np.uint32))
    return Plan(setting, curve, lowest_level(levels_of(size)))


def leaves(splats: Splats, index: NDArray[np.int64], plan: Plan) -> Pending:
    """Return splats as pending nodes; see `StagedBuilder.leaves`."""
    return dict(vars(splats))


def advance(
    pending: Pending, region: Region | None, stage: int, plan: Plan, *, progress: Progress
) -> tuple[StageFamilies, Pending]:
    """Merge and prune the nodes of a region; see `StagedBuilder.advance`."""
    splats = drawn_splats(pending)
    count = len(splats)
    if count <= 1:
        everything = np.arange(count, dtype=np.uint32)
        none = splats.take(slice(0, 0))
        empty = np.empty(0, np.int32), np.empty((0, 1), np.uint64), np.empty(0, np.uint16)
        families = StageFamilies(*empty, none, np.empty(0, np.int64), none.center, none.opacity)
        return families, {**vars(splats), **vars(_Columns.of(pending, everything, plan))}
    curve = plan.curve.around(splats.center)
    with threads_for(count) as threads:
        index = curve.order(splats.center, threads)
        nodes = _Columns.of(pending, index, plan)
        binary = BinaryTree.of_leaves(nodes.rows, nodes.size)
        nodes = replace(nodes, rows=np.empty((0, WIDTH), np.float32))  # the tree writes over them
        left = merge_levels(binary, nodes.level, curve, region, progress)
        goal = _pruning_goal(nodes, len(left[0]), region, plan)
        final = in_final_order(binary, index, dict(vars(splats)), goal, plan.curve, progress)
    numbers = np.full(len(final.order), NO_FAMILY, np.int64)
    is_leaf = final.order < count
    numbers[is_leaf] = nodes.family[final.order[is_leaf]]
    numbers[final.parents] = (stage << STAGE_BITS) | np.arange(len(final.parents))
    children, parents = slice(final.first_child, None), final.splats.take(final.parents)
    families = StageFamilies(
        batch=final.ranks,
        key=final.keys[:, None],
        count=final.tree.child_count[final.parents],
        nodes=final.splats.take(children),
        family=numbers[children],
        center=parents.center,
        size=spark_size(parents),
    )
    if region is None:
        return families, {**vars(final.splats.take(slice(1))), "family": numbers[:1]}
    sums = int(nodes.leaves.sum()), int(nodes.merged.sum()) + len(final.parents)
    return families, _rest(final, pending, index, left, numbers, sums, plan)


def _pruning_goal(nodes: _Columns, handed: int, region: Region | None, plan: Plan) -> PruningGoal:
    """Return the goal of a stage that leaves `handed` nodes pending."""
    splats = int(nodes.leaves.sum())
    most = int(plan.growth * splats) - splats - int(nodes.merged.sum())
    if region is None:
        one_stage = bool((nodes.family == NO_FAMILY).all())  # then the tree is that of `quality.build`
        return PruningGoal(max(most, 1), splats, highest=None if one_stage else HIGHEST, latest=nodes.rank)
    reserve = max(1, math.ceil(min(RESERVE * (plan.growth - 1), 1) * handed))
    return PruningGoal(max(most - reserve, 0), splats, False, HIGHEST, nodes.rank)


def _rest(
    final: FinalTree,
    pending: Pending,
    index: Nodes,
    left: tuple[Nodes, Levels],
    numbers: NDArray[np.int64],
    sums: tuple[int, int],
    plan: Plan,
) -> Pending:
    """Return the nodes that a stage leaves pending: the roots of the pruned tree, behind its placeholder.

    Args:
        index: (n,) places of the tree's leaves in `pending`.
        left: roots before the tree was pruned, and the levels at which they merge next.
        numbers: (M,) of the families of the nodes of `final`.
        sums: numbers of leaves and of merged nodes under all pending nodes.
    """
    here = slice(1, final.first_child)
    splats, node, family = final.splats.take(here), final.order[here], numbers[here]
    merged = node >= len(index)
    nodes = _Columns.of(pending, index[np.where(merged, 0, node)], plan)
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
    return {**vars(splats), **vars(replace(nodes, family=family))}
