"""The quick builder in stages: the tree that `lod.quick` builds, node for node and bit for bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...model.gaussian import spark_size
from ...model.lod_tree import LodTree
from ...model.splats import COLUMNS, Splats
from ...support.defaults import MAX_BASE, MIN_BASE
from ...support.jit import threads_for
from ...support.progress import Progress, silent
from ..check import Bounds, check_setting
from ..kernels.geometry import CENTER, OPACITY, QUAT, SCALE, WIDTH, SplatColumns, gather_rows
from ..kernels.sort import Keys, Nodes, cell_words, sort_by_key
from ..margins import Margins
from ..voxel_grid import VoxelGrid
from ..voxel_growth import Arrivals, grow
from ..voxel_tree import SHRINK, Batch, VoxelTree, final_order, in_order
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
    given = pending.columns
    with threads_for(len(pending)) as threads:
        pick, arrivals = _arrivals(pending, plan, threads)
        tree = _rows(pending, pick)
        left = grow(tree, plan, arrivals, Margins(plan, region.low, region.high) if region else None, progress)
        rows = tree.geometry[left.nodes]
        batch, key, count = _places(tree, plan)
        order = final_order(tree, left.nodes)
        nodes, links = in_order(tree, order, pick, given["rgb"], given["sh"])
    parents, family = _families(links, count, len(rows), stage)
    was_given = order < tree.given
    family[was_given] = given["family"][pick[order[was_given]]]
    is_new = left.nodes < arrivals.splats
    is_new[is_new] = np.searchsorted(arrivals.joins, left.nodes[is_new], "right") == left.levels[is_new]
    index = np.full(len(rows), -1, np.int64)
    index[is_new] = given["index"][pick[left.nodes[is_new]]]
    drawn = nodes.take(parents)
    made = slice(len(rows), None)
    handed_on = {
        "center": rows[:, CENTER:SCALE].copy(),
        "scale": rows[:, SCALE:QUAT].copy(),
        "quat_xyzw": rows[:, QUAT:OPACITY].copy(),
        "opacity": rows[:, OPACITY].copy(),
        "rgb": nodes.rgb[: len(rows)].copy(),
        "sh": nodes.sh[: len(rows)].copy(),
        "weight": tree.weight[left.nodes],
        "level": np.where(is_new, np.int32(NEW), left.levels),
        "index": index,
        "family": family[: len(rows)].copy(),
    }
    families = Families(batch, key, count, nodes.take(made), family[made], drawn.center, spark_size(drawn))
    return families, Pending(handed_on)


def root(pending: Pending) -> tuple[Splats, int]:
    """The one node that is left, as it is drawn, and the number of its family."""
    columns = {name: pending.columns[name] for name in COLUMNS}
    family = int(pending.columns["family"][0])
    if family != NO_FAMILY:
        columns["scale"] = columns["scale"] * SHRINK
    return Splats(**columns), family


def _arrivals(pending: Pending, grid: VoxelGrid, threads: int) -> tuple[Nodes, Arrivals]:
    """(n,) the pending node of each row, and when the rows take part.

    New splats come first, by level, curve and index, as in memory; then other splats; then merged ones.
    """
    given = pending.columns
    is_new = given["level"] == NEW
    new = np.flatnonzero(is_new).astype(np.uint32)
    index = given["index"][new]
    if len(index) and (np.diff(index) < 0).any():
        new = sort_by_key(index.astype(np.uint64), new, int(index.max()).bit_length(), threads)[1]
    keys, levels, bits = grid.leaf_keys(given["center"][new], given["scale"][new])
    new = sort_by_key(keys, new, bits, threads)[1]
    old = np.flatnonzero(~is_new).astype(np.uint32)
    is_merged = given["family"][old] != NO_FAMILY
    old = np.concatenate([old[~is_merged], old[is_merged]])
    waits_for = given["level"][old]
    waiting = (np.argsort(waits_for, kind="stable") + len(new)).astype(np.uint32)
    arrivals = Arrivals(np.cumsum(np.bincount(levels)), waiting, np.cumsum(np.bincount(waits_for)))
    return np.concatenate([new, old]), arrivals


def _rows(pending: Pending, pick: Nodes) -> VoxelTree:
    """A tree with the picked nodes."""
    given, n = pending.columns, len(pending)
    geometry, weight = np.empty((2 * n, WIDTH), np.float32), np.empty(2 * n, np.float64)
    columns = SplatColumns(given["center"], given["scale"], given["quat_xyzw"], given["opacity"])
    gather_rows(pick, columns, geometry, weight)
    merged = int(np.count_nonzero(given["family"] != NO_FAMILY))
    weight[n - merged : n] = given["weight"][pick[n - merged :]]  # not that of the rounded opacity
    return VoxelTree(geometry, weight, n - merged, n, n)


def _places(tree: VoxelTree, grid: VoxelGrid) -> tuple[NDArray[np.int32], Keys, NDArray[np.uint16]]:
    """Batch, key and number of children of each family, in their order."""
    words = grid.words(0)
    batches = [np.empty(0, np.int32)]
    keys, counts = [np.empty((0, words), np.uint64)], [np.empty(0, np.uint16)]
    for batch in reversed(tree.batches):
        made = np.arange(batch.row, batch.row + len(batch.first) - 1, dtype=np.uint32)
        step, low_cell, _ = grid.cells(batch.level)
        each = [cell_words(tree.geometry, made, step, low_cell, word) for word in reversed(range(words))]
        batches.append(np.full(len(made), _number(batch), np.int32))
        keys.append(np.stack(each, axis=1))
        counts.append(np.diff(batch.first).astype(np.uint16))
    return np.concatenate(batches), np.concatenate(keys), np.concatenate(counts)


def _number(batch: Batch) -> int:
    """The number of a batch in the tree: coarse levels first, folds after the batches that they are merged in."""
    return (LEVELS - batch.level) * FOLDS + (FOLDS - batch.fold if batch.fold else 0)


def _families(
    links: LodTree, count: NDArray[np.uint16], tops: int, stage: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The parent of each family of a stage, and the number of the family of each node; `NO_FAMILY` for the others."""
    starts = np.cumsum(count, dtype=np.int64) - count + tops
    place = np.empty(len(links) + 1, np.int64)
    place[starts] = np.arange(len(count))
    inner = np.flatnonzero(links.child_count)
    mine = place[links.child_start[inner]]
    parents = np.empty(len(count), np.int64)
    parents[mine] = inner
    family = np.full(len(links), NO_FAMILY, np.int64)
    family[inner] = (np.int64(stage) << STAGE_BITS) | mine
    return parents, family
