"""Quick-LoD: a tree of merged splats from voxel grids that grow by a constant factor.

The levels are those of Spark's method ("Quick LoD algorithm"): a splat of size s = 2 * max(scale) belongs to level
ceil(log_base(s)), and from the finest level up, the splats of a level join the survivors of the level below. There, all
nodes that share a cell become one. Here, cells are wider, and in each the cheapest pairs of neighbours merge for a few
rounds, up to a size that grows with the level; what became one node is a family (`kernels/cell_pairs.py`).
benchmarks/notes/quick-builder.md has the reasons, and the alternatives that were tried.

For speed, leaves are sorted once, by level and Morton code, into rows with all data that a merge reads, so that each
level reads neighbouring memory. A level is a radix sort of its cells and one parallel merge. As the nodes of a level
are made in Morton order, writing the levels out backwards gives the final order, coarse before fine.

The same tree can be built in stages, node for node and bit for bit. Of a region, only cells get a node that no other
node of the scene can be in; what lies in the others is left. Where unknown nodes will be merged is unknown, too, but in
the cells that their members lie in: a mean lies between its terms, and float32 rounds it no further. So what is unknown
at a level ends where the cells of the level below end that something unknown could be in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import COLUMNS, FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import threads_for
from .builders import DEFAULT_BASE, MAX_BASE, MIN_BASE
from .check import Bounds, check, check_setting
from .kernels.pair_cost import WIDTH
from .kernels.sort import PART_BITS, Keys, Nodes, cell_words, sort_by_cell, sort_by_key
from .voxel_grid import Margins, VoxelGrid
from .voxel_tree import (
    MERGED,
    Final,
    Joining,
    NodeRows,
    Offsets,
    VoxelTree,
    fill_rows,
    joining,
)

if TYPE_CHECKING:  # builds in memory do without
    from .stage_records import Pending, Region, StageFamilies

#: Level of splats that have not joined the tree yet: they do so at the level of their size.
NEW = -1

#: More than the levels of any scene: sizes and distances of float32 span 2 ** 278, and the base is at least 1.1.
LEVELS = 4096


def build(splats: Splats, base: float = DEFAULT_BASE, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Build a Level-of-Detail tree.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: nodes whose parents were made at a coarser level come first, and along a Morton curve within a level.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        base: growth of the cells from level to level, 1.1 to 2.0.

    Returns:
        M >= N splats and their tree; merged ones have linear opacities up to 1000.

    Raises:
        InvalidSplatsError: there are no splats, or one is invisible.
        ValueError: the base is out of range.
    """
    check_setting("base", base, MIN_BASE, MAX_BASE)
    n = len(splats)
    bounds = check(splats)
    with threads_for(n) as threads:
        grid = VoxelGrid.of(bounds, base)
        index, joins = grid.sorted_leaves(splats.center, splats.scale, threads)
        arrivals = Arrivals(n, joining(index, joins, lambda some, rows: fill_rows(some, splats, grid.space, rows)))
        tree = VoxelTree(n, n, grid.space)
        ((_, root),) = grow(tree, grid, arrivals, None, progress)
        final = tree.finish(root, index, splats)
    return final.nodes, final.tree


@dataclass(frozen=True, eq=False)
class Arrivals:
    """The nodes that take part, each from some level on. Lists are emptied as they do, so that memory is freed.

    Attributes:
        splats: number of splats that join at the level of their size.
        joining: those splats by level, each along the curve.
        waiting: rows of other nodes by the level that they wait for; all nodes in a cell of the level below come from
            one stage, in their order.
    """

    splats: int
    joining: dict[int, Joining]
    waiting: dict[int, NodeRows] = field(default_factory=dict)


def grow(
    tree: VoxelTree, grid: VoxelGrid, arrivals: Arrivals, margins: Margins | None, progress: Progress
) -> list[tuple[int, NodeRows]]:
    """Merge the nodes of each cell, level by level.

    Args:
        arrivals: all nodes that are given; it is emptied.
        margins: of the region that they are in, at level 0; None if they are all that there are, and get one root.

    Returns:
        the nodes without a parent, by the level that they wait for; only the root if there are no margins.
    """
    active, level, joined = np.empty(0, np.uint32), 0, 0
    last = max(0, int(np.searchsorted(grid.steps, grid.largest)))  # a splat joins at its level at most
    left: list[tuple[int, NodeRows]] = []
    while True:
        if level in arrivals.waiting:
            active = tree.join(active, arrivals.waiting.pop(level))
            active = _by_cell(tree, grid, level - 1, active, within=False)[0]
        if level > last and not arrivals.waiting and len(active) <= 1:
            break
        if margins is not None:
            margins.widen(level)
            if margins.are_closed:
                break
        if level in arrivals.joining:
            new = arrivals.joining.pop(level)
            joined += len(new)
            active = tree.join(active, new)
            progress("building", joined, arrivals.splats, "splat")
        if margins is not None:
            active, outside = margins.split(active, tree.rows.node)
            left.append((level, tree.rows.take(outside)))
        if len(active) > 1:
            with threads_for(len(active)):
                active = tree.tidy(active)
                active = tree.merge_cells(level, *_by_cell(tree, grid, level, active), grid.largest_trace(level))
        level += 1
    left.append((level, tree.rows.take(active)))
    unjoined = [(level, splats.rows()) for level, splats in arrivals.joining.items()]
    return left + unjoined + list(arrivals.waiting.items())


def _by_cell(
    tree: VoxelTree, grid: VoxelGrid, level: int, nodes: Nodes, *, within: bool = True
) -> tuple[Nodes, NDArray[np.bool_]]:
    """`sort_by_cell` of the cells of a level."""
    with threads_for(len(nodes)) as threads:
        return sort_by_cell(tree.rows.node, nodes, grid.parts(level), threads, within=within)


def plan(bounds: Bounds, sample: Splats, setting: float) -> VoxelGrid:
    """Return the grid of the scene; the setting is the base, and `ValueError` is raised if it is out of range."""
    check_setting("base", setting, MIN_BASE, MAX_BASE)
    return VoxelGrid.of(bounds, setting)


def leaves(splats: Splats, index: NDArray[np.int64], plan: VoxelGrid) -> Pending:
    """Return splats that have not joined the tree."""
    from .stage_records import NO_FAMILY, Pending

    n = len(splats)
    rows = np.empty((n, WIDTH), np.float32)
    fill_rows(np.arange(n, dtype=np.uint32), splats, plan.space, rows)
    level, family = np.full(n, NEW, np.int32), np.full(n, NO_FAMILY, np.int64)
    return Pending.of(splats, rows=rows, level=level, index=index, family=family)


def advance(
    pending: Pending, region: Region | None, stage: int, plan: VoxelGrid, *, progress: Progress = silent
) -> tuple[StageFamilies, Pending]:
    """Merge the nodes of cells that no unknown node can be in.

    Families with the same batch and key come from one stage: a stable sort keeps them as they are.
    """
    from .stage_records import NO_FAMILY, STAGE_BITS, Pending

    given = dict(pending.columns)
    del pending
    with threads_for(len(given["level"])) as threads:
        pick, joins, arrivals, leaves = _arrivals(given, plan, threads)
        del given["rows"]  # the arrivals have them
        tree = VoxelTree(len(pick), leaves, plan.space, partial(_keys, plan))
        margins = Margins(plan, region.low, region.high) if region else None
        left = grow(tree, plan, arrivals, margins, progress)
        tops = NodeRows.concat([rows for _, rows in left])
        final = tree.finish(tops, pick, Splats(**{name: given[name] for name in COLUMNS}))
    waits = np.repeat(np.array([level for level, _ in left], np.int32), [len(rows) for _, rows in left])
    was_given = tops.count == 0
    family = np.full(len(final.tree), NO_FAMILY, np.int64)
    is_given = final.number != MERGED
    family[is_given] = given["family"][pick[final.number[is_given]]]
    family[final.parents] = (np.int64(stage) << STAGE_BITS) | np.arange(len(final.parents))
    # A splat that waits for the level of its own size has not joined.
    is_new = was_given & (tops.number < arrivals.splats)
    is_new[is_new] = np.searchsorted(joins, tops.number[is_new], "right") == waits[is_new]
    index = np.full(len(tops), -1, np.int64)
    index[is_new] = given["index"][pick[tops.number[is_new]]]
    drawn = final.nodes.take(slice(len(tops)))
    handed_on = Pending.of(
        Splats(**{name: column.copy() for name, column in vars(drawn).items()}),
        rows=tops.node,
        level=np.where(is_new, np.int32(NEW), waits),
        index=index,
        family=family[: len(tops)].copy(),
    )
    return _families(tree, final, family, len(tops), plan.parts(0).words), handed_on


def _arrivals(given: Mapping[str, NDArray[Any]], grid: VoxelGrid, threads: int) -> tuple[Nodes, Offsets, Arrivals, int]:
    """Return the pending node of each number, where each level ends among the new splats, and the rows.

    New splats have the first numbers, by level, curve and index, as in memory; then come other splats, then merged
    ones. The last value is the number of the first of these.
    """
    from .stage_records import NO_FAMILY

    is_new = given["level"] == NEW
    new, old = (np.flatnonzero(mask).astype(np.uint32) for mask in (is_new, ~is_new))
    index, order = given["index"][new], None
    if (np.diff(index) < 0).any():
        order = np.arange(len(new), dtype=np.uint32)
        order = sort_by_key(index.astype(np.uint64), order, int(index.max()).bit_length(), threads)[1]
    every = len(old) == 0
    center, scale = (column if every else column[new] for column in (given["center"], given["scale"]))
    order, joins = grid.sorted_leaves(center, scale, threads, order)
    new = new[order]
    is_merged = given["family"][old] != NO_FAMILY
    merged = len(old) - int(np.count_nonzero(is_merged))
    place = old
    old = np.concatenate([old[~is_merged], old[is_merged]])
    numbers = np.arange(len(new), len(new) + len(old), dtype=np.uint32)
    survivors = NodeRows(given["rows"][old], numbers, np.zeros(len(old), np.uint16))
    number = np.empty(len(old), np.uint32)  # among the survivors, of each in the order of the stages
    number[np.searchsorted(place, old)] = np.arange(len(old), dtype=np.uint32)
    levels = given["level"][place]
    waiting = {level: survivors.take(number[levels == level]) for level in np.unique(levels).tolist()}
    rows: FloatArray = given["rows"]

    def fill(some: Nodes, out: FloatArray) -> None:
        np.take(rows, some, axis=0, out=out, mode="clip")

    arrivals = Arrivals(len(new), joining(new, joins, fill), waiting)
    return np.concatenate([new, old]), joins, arrivals, len(new) + merged


def _keys(grid: VoxelGrid, level: int, rows: FloatArray) -> Keys:
    """Return Morton codes of the cells of a level that rows are in, the highest word first."""
    parts, nodes = grid.parts(level), np.arange(len(rows), dtype=np.uint32)
    words = [cell_words(rows, nodes, parts, word) for word in range(grid.parts(0).words)]
    words[0] &= ~np.uint64((1 << 3 * PART_BITS) - 1)
    return np.stack(words[::-1], axis=1)


def _families(tree: VoxelTree, final: Final, family: NDArray[np.int64], tops: int, words: int) -> StageFamilies:
    """Return the families of a stage, from its nodes and their families; the first are without a parent."""
    from .stage_records import StageFamilies

    batches = tree.batches[::-1]
    number = np.array([LEVELS - batch.level for batch in batches], np.int32)  # coarse levels first
    parents = final.nodes.take(final.parents)
    return StageFamilies(
        batch=np.repeat(number, [batch.families for batch in batches]),
        key=np.concatenate([*(batch.keys for batch in batches), np.empty((0, words), np.uint64)]),
        count=final.tree.child_count[final.parents],
        nodes=final.nodes.take(slice(tops, None)),
        family=family[tops:],
        center=parents.center,
        size=spark_size(parents),
    )
