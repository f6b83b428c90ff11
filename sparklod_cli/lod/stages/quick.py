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
from ..kernels.geometry import CENTER, OPACITY, QUAT, SCALE, SplatColumns
from ..kernels.sort import Keys, Nodes, cell_words, sort_by_key
from ..margins import Margins
from ..voxel_grid import VoxelGrid
from ..voxel_growth import Arrivals, grow
from ..voxel_rows import by_level, joining, rows_of, sorted_leaves
from ..voxel_tree import MADE, SHRINK, Batch, Final, Offsets, Rows, VoxelTree
from .records import NO_FAMILY, STAGE_BITS, Families, Pending, Region, Survey

#: Level of splats that have not joined the tree yet: they do so at the level of their size.
NEW = -1

#: More than the levels of any scene: sizes and distances of float32 span 2 ** 278, and the base is at least 1.1.
LEVELS = 4096

#: More than the folds of a cell, each of which leaves at most half of the nodes.
FOLDS = 64


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
    columns = {name: getattr(splats, name) for name in COLUMNS}
    level, family = np.full(n, NEW, np.int32), np.full(n, NO_FAMILY, np.int64)
    return Pending({**columns, "weight": np.zeros(n), "level": level, "index": index, "family": family})


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
        for name in ("center", "scale", "quat_xyzw", "opacity", "weight"):
            del given[name]  # the rows have them; frees the memory if the caller has no reference
        tree = VoxelTree(len(pick), leaves, partial(_keys, plan))
        margins = Margins(plan, region.low, region.high) if region else None
        left = grow(tree, plan, arrivals, margins, progress)
        tops = Rows.concat([rows for _, rows in left])
        final = tree.finish(tops, pick, given["rgb"], given["sh"])
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
        "center": tops.geometry[:, CENTER:SCALE].copy(),
        "scale": tops.geometry[:, SCALE:QUAT].copy(),
        "quat_xyzw": tops.geometry[:, QUAT:OPACITY].copy(),
        "opacity": tops.geometry[:, OPACITY].copy(),
        "rgb": final.nodes.rgb[: len(tops)].copy(),
        "sh": final.nodes.sh[: len(tops)].copy(),
        "weight": tops.weight,
        "level": np.where(is_new, np.int32(NEW), waits),
        "index": index,
        "family": family[: len(tops)].copy(),
    }
    return _families(tree, final, family, len(tops), plan.words(0)), Pending(handed_on)


def root(pending: Pending) -> tuple[Splats, int]:
    """The one node that is left, as it is drawn, and the number of its family."""
    columns = {name: pending.columns[name] for name in COLUMNS}
    family = int(pending.columns["family"][0])
    if family != NO_FAMILY:
        columns["scale"] = columns["scale"] * SHRINK
    return Splats(**columns), family


def _arrivals(given: Mapping[str, NDArray[Any]], grid: VoxelGrid, threads: int) -> tuple[Nodes, Offsets, Arrivals, int]:
    """What takes part: the pending node of each number, where each level ends among the new splats, and the rows.

    New splats have the first numbers, by level, curve and index, as in memory; then come other splats, then merged
    ones. The last value is the number of the first of these.
    """
    is_new = given["level"] == NEW
    new, old = (np.flatnonzero(mask).astype(np.uint32) for mask in (is_new, ~is_new))
    columns = SplatColumns(given["center"], given["scale"], given["quat_xyzw"], given["opacity"])
    index, order = given["index"][new], None
    if (np.diff(index) < 0).any():
        order = np.arange(len(new), dtype=np.uint32)
        order = sort_by_key(index.astype(np.uint64), order, int(index.max()).bit_length(), threads)[1]
    every = len(old) == 0
    center, scale = (column if every else column[new] for column in (given["center"], given["scale"]))
    order, joins = sorted_leaves(center, scale, grid, threads, order)
    new = new[order]
    is_merged = given["family"][old] != NO_FAMILY
    old = np.concatenate([old[~is_merged], old[is_merged]])
    survivors = rows_of(old, len(new), columns)
    merged = len(old) - int(np.count_nonzero(is_merged))
    survivors.weight[merged:] = given["weight"][old[merged:]]  # not that of the rounded opacity
    waiting = {level: survivors.take(at) for level, at in by_level(given["level"][old])}
    arrivals = Arrivals(len(new), joining(new, joins, columns), waiting)
    return np.concatenate([new, old]), joins, arrivals, len(new) + merged


def _keys(grid: VoxelGrid, level: int, rows: FloatArray) -> Keys:
    """Morton codes of the cells of a level that rows are in, the highest word first."""
    step, low_cell, _ = grid.cells(level)
    nodes = np.arange(len(rows), dtype=np.uint32)
    words = [cell_words(rows, nodes, step, low_cell, word) for word in reversed(range(grid.words(0)))]
    return np.stack(words, axis=1)


def _number(batch: Batch) -> int:
    """The number of a batch in the tree: coarse levels first, folds after the batches that they are merged in."""
    return (LEVELS - batch.level) * FOLDS + (FOLDS - batch.fold if batch.fold else 0)


def _families(tree: VoxelTree, final: Final, family: NDArray[np.int64], tops: int, words: int) -> Families:
    """The families of a stage, from its nodes and the number of the family of each; the first are without a parent."""
    batches = tree.batches[::-1]
    number = np.array([_number(batch) for batch in batches], np.int32)
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
