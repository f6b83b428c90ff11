"""The quick builder in stages: the tree that `lod.quick` builds, node for node and bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import spark_size
from ...model.splats import COLUMNS, FloatArray, Splats
from ...support.defaults import MAX_BASE, MIN_BASE
from ...support.jit import threads_for
from ...support.progress import Progress, silent
from ..check import Bounds, check_setting
from ..kernels.sort import PART_BITS, Keys, Nodes, cell_words, sort_by_key
from ..margins import Margins
from ..voxel_grid import VoxelGrid
from ..voxel_growth import Arrivals, grow
from ..voxel_rows import by_level, joining, leaf_rows, numbered, sorted_leaves
from ..voxel_tree import MADE, Final, Offsets, Rows, VoxelTree
from .records import NO_FAMILY, STAGE_BITS, Families, Pending, Region, Survey

#: Level of splats that have not joined the tree yet: they do so at the level of their size.
NEW = -1

#: More than the levels of any scene: sizes and distances of float32 span 2 ** 278, and the base is at least 1.1.
LEVELS = 4096


def plan(survey: Survey, setting: float) -> VoxelGrid:
    """The grid of the scene; the setting is the base.

    Raises:
        ValueError: the base is out of its range.
    """
    check_setting("base", setting, MIN_BASE, MAX_BASE)
    return VoxelGrid.of(Bounds(np.array(survey.low), np.array(survey.high), survey.smallest, survey.largest), setting)


def leaves(splats: Splats, index: NDArray[np.int64], plan: VoxelGrid) -> Pending:
    """Splats that have not joined the tree."""
    n = len(splats)
    rows = leaf_rows(np.arange(n, dtype=np.uint32), splats, plan.space)
    level, family = np.full(n, NEW, np.int32), np.full(n, NO_FAMILY, np.int64)
    return Pending(
        {
            **{name: getattr(splats, name) for name in COLUMNS},
            "rows": rows,
            "level": level,
            "index": index,
            "family": family,
        }
    )


def advance(
    pending: Pending, region: Region | None, stage: int, plan: VoxelGrid, *, progress: Progress = silent
) -> tuple[Families, Pending]:
    """Merges the nodes of cells that no unknown node can be in.

    Families with the same batch and key come from one stage: a stable sort keeps them as they are.
    """
    given = dict(pending.columns)
    del pending
    with threads_for(len(given["level"])) as threads:
        pick, joins, arrivals, leaves = _arrivals(given, plan, threads)
        del given["rows"]  # the arrivals have them
        tree = VoxelTree(len(pick), leaves, plan.space, partial(_keys, plan))
        margins = Margins(plan, region.low, region.high) if region else None
        left = grow(tree, plan, arrivals, margins, progress)
        tops = Rows.concat([rows for _, rows in left])
        final = tree.finish(tops, pick, Splats(**{name: given[name] for name in COLUMNS}))
    waits = np.repeat(np.array([level for level, _ in left], np.int32), [len(rows) for _, rows in left])
    was_given = tops.count == 0
    family = np.full(len(final.tree), NO_FAMILY, np.int64)
    is_given = final.number != MADE
    family[is_given] = given["family"][pick[final.number[is_given]]]
    family[final.parents] = (np.int64(stage) << STAGE_BITS) | np.arange(len(final.parents))
    # A splat that waits for the level of its own size has not joined.
    is_new = was_given & (tops.number < arrivals.splats)
    is_new[is_new] = np.searchsorted(joins, tops.number[is_new], "right") == waits[is_new]
    index = np.full(len(tops), -1, np.int64)
    index[is_new] = given["index"][pick[tops.number[is_new]]]
    handed_on = {
        **{name: column.copy() for name, column in _drawn(final.nodes.take(slice(len(tops)))).items()},
        "rows": tops.node,
        "level": np.where(is_new, np.int32(NEW), waits),
        "index": index,
        "family": family[: len(tops)].copy(),
    }
    return _families(tree, final, family, len(tops), plan.parts(0).words), Pending(handed_on)


def root(pending: Pending) -> tuple[Splats, int]:
    """The one node that is left, as it is drawn, and the number of its family."""
    return Splats(**{name: pending.columns[name] for name in COLUMNS}), int(pending.columns["family"][0])


def _drawn(splats: Splats) -> dict[str, FloatArray]:
    """Columns of `Pending` that tell how nodes are drawn."""
    return {name: getattr(splats, name) for name in COLUMNS}


def _arrivals(given: Mapping[str, NDArray[Any]], grid: VoxelGrid, threads: int) -> tuple[Nodes, Offsets, Arrivals, int]:
    """What takes part: the pending node of each number, where each level ends among the new splats, and the rows.

    New splats have the first numbers, by level, curve and index, as in memory; then come other splats, then merged
    ones. The last value is the number of the first of these.
    """
    is_new = given["level"] == NEW
    new, old = (np.flatnonzero(mask).astype(np.uint32) for mask in (is_new, ~is_new))
    index, order = given["index"][new], None
    if (np.diff(index) < 0).any():
        order = np.arange(len(new), dtype=np.uint32)
        order = sort_by_key(index.astype(np.uint64), order, int(index.max()).bit_length(), threads)[1]
    every = len(old) == 0
    center, scale = (column if every else column[new] for column in (given["center"], given["scale"]))
    order, joins = sorted_leaves(center, scale, grid, threads, order)
    new = new[order]
    is_merged = given["family"][old] != NO_FAMILY
    merged = len(old) - int(np.count_nonzero(is_merged))
    place = old
    old = np.concatenate([old[~is_merged], old[is_merged]])
    survivors = numbered(given["rows"][old], len(new))
    number = np.empty(len(old), np.uint32)  # among the survivors, of each in the order of the stages
    number[np.searchsorted(place, old)] = np.arange(len(old), dtype=np.uint32)
    waiting = {level: survivors.take(number[at]) for level, at in by_level(given["level"][place])}
    rows: FloatArray = given["rows"]

    def fill(some: Nodes, out: FloatArray) -> None:
        np.take(rows, some, axis=0, out=out, mode="clip")

    arrivals = Arrivals(len(new), joining(new, joins, fill), waiting)
    return np.concatenate([new, old]), joins, arrivals, len(new) + merged


def _keys(grid: VoxelGrid, level: int, rows: FloatArray) -> Keys:
    """Morton codes of the cells of a level that rows are in, the highest word first."""
    parts, nodes = grid.parts(level), np.arange(len(rows), dtype=np.uint32)
    words = [cell_words(rows, nodes, parts.step, parts.low, word) for word in range(grid.parts(0).words)]
    words[0] &= ~np.uint64((1 << 3 * PART_BITS) - 1)
    return np.stack(words[::-1], axis=1)


def _families(tree: VoxelTree, final: Final, family: NDArray[np.int64], tops: int, words: int) -> Families:
    """The families of a stage, from its nodes and the number of the family of each; the first are without a parent."""
    batches = tree.batches[::-1]
    number = np.array([LEVELS - batch.level for batch in batches], np.int32)  # coarse levels first
    parents = final.nodes.take(final.parents)
    return Families(
        batch=np.repeat(number, [batch.families for batch in batches]),
        key=np.concatenate([*(batch.keys for batch in batches), np.empty((0, words), np.uint64)]),
        count=final.tree.child_count[final.parents],
        nodes=final.nodes.take(slice(tops, None)),
        family=family[tops:],
        center=parents.center,
        size=spark_size(parents),
    )
