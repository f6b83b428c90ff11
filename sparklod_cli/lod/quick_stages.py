"""The quick builder in stages: node for node and bit for bit the tree of `quick.build`.

In a region, only those cells are merged that no node from outside can be in; the other nodes stay pending. Nodes from
outside merge into nodes within the cells of their members: a mean lies between its terms, and so does its float32. So
the margin of possible nodes from outside grows by whole cells, level by level.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.splats import FloatArray, Splats
from ..system.progress import Progress, silent
from ..system.threads import threads_for
from .kernels.geometry import SplatColumns
from .kernels.node_rows import fill_leaf_rows
from .kernels.pair_merge import WIDTH
from .kernels.sort import PART_BITS, Nodes, Parts, sort_by_key, split_box
from .quick import MERGED, NodeRows, Offsets, VoxelGrid, VoxelTree
from .quick import plan as plan
from .stages import NO_FAMILY, STAGE_BITS, Pending, Region, StageFamilies, drawn_splats

#: Level of pending splats that have not joined the tree: they join at the level of their size.
NEW = -1

#: Upper bound of the levels of a scene: sizes and distances of float32 span 2 ** 278, and the base is at least 1.1.
LEVELS = 4096

#: Parts of a cell on an axis.
CELL_PARTS = 1 << PART_BITS

FLOAT_MAX = np.float32(np.finfo(np.float32).max)
INFINITY = np.float32(np.inf)


class Margins:
    """The centres that unknown nodes can have: on some axis, at most `below` or at least `above`; in units.

    A stage does not know all nodes outside of its region and near its faces.
    """

    def __init__(self, box: NDArray[np.float64], unit: float, region: Region) -> None:
        """Take all centres outside of the region, which is right before the first level.

        Args:
            box: (2, 3) corners of the box of all centres of the scene, units.
            unit: length of a unit, world units.
        """
        self._low, self._high = box.tolist()
        # Rounded as the centres in rows.
        self._below = [_rounded(value / unit) for value in region.low]
        self._above = [_rounded(value / unit) for value in region.high]

    def widen(self, parts: Parts) -> None:
        """Extend the margins to whole cells of the next level."""
        edge = float(parts.step)
        for axis, lowest in enumerate(parts.low.tolist()):
            below, above = self._below[axis], self._above[axis]
            # No centre lies outside of the box of the scene, known or unknown.
            has_below, has_above = below >= self._low[axis], above <= self._high[axis]
            last = _first_part(float(below), edge, lowest) + CELL_PARTS - 1 if has_below else 0
            first = _first_part(float(above), edge, lowest) if has_above else 0
            self._below[axis] = _last_of_part(last, edge) if has_below else -INFINITY
            self._above[axis] = np.nextafter(_last_of_part(first - 1, edge), INFINITY) if has_above else INFINITY

    @property
    def are_closed(self) -> bool:
        """Whether the margins cover the whole box of the scene."""
        sides = zip(self._below, self._above, self._low, self._high, strict=True)
        return any(float(below) >= min(float(above), high) or float(above) <= low for below, above, low, high in sides)

    def split(self, nodes: Nodes, geometry: FloatArray) -> tuple[Nodes, Nodes]:
        """Separate the nodes in cells without unknown nodes from the nodes in the margins."""
        return split_box(nodes, geometry, np.array(self._below), np.array(self._above))


def _rounded(value: float) -> np.float32:
    """Return the nearest float32: infinite only for an infinite value."""
    return np.float32(value if math.isinf(value) else min(max(value, -float(FLOAT_MAX)), float(FLOAT_MAX)))


def _first_part(value: float, edge: float, lowest: int) -> int:
    """Return the first part of the cell that a coordinate is in; `lowest` is the first part of the lowest cell."""
    return (math.floor(value / edge) - lowest) // CELL_PARTS * CELL_PARTS + lowest


def _last_of_part(part: int, edge: float) -> np.float32:
    """Return the largest float32 in a part of an axis or in any part below it."""
    near = _rounded((part + 1) * edge)
    while near > -FLOAT_MAX and math.floor(float(near) / edge) > part:
        near = np.nextafter(near, -INFINITY)
    while near < FLOAT_MAX and math.floor(float(after := np.nextafter(near, INFINITY)) / edge) <= part:
        near = after
    return near


def leaves(splats: Splats, index: NDArray[np.int64], plan: VoxelGrid) -> Pending:
    """Return splats as pending nodes that have not joined the tree; see `StagedBuilder.leaves`."""
    n = len(splats)
    rows, every = np.empty((n, WIDTH), np.float32), np.arange(n, dtype=np.uint32)
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    fill_leaf_rows(n, every, columns, splats.rgb, plan.space, rows, np.empty(n, np.float32))
    level, family = np.full(n, NEW, np.int32), np.full(n, NO_FAMILY, np.int64)
    return {**vars(splats), "rows": rows, "level": level, "index": index, "family": family}


def advance(
    pending: Pending, region: Region | None, stage: int, plan: VoxelGrid, *, progress: Progress = silent
) -> tuple[StageFamilies, Pending]:
    """Merge the nodes of cells that no unknown node can be in; see `StagedBuilder.advance`.

    Families with the same batch and key come from one stage, where they are in order: a stable sort keeps it.
    """
    with threads_for(len(pending["level"])) as threads:
        tree, given, ends = _tree(pending, plan, threads)
        margins = Margins(plan.box, float(plan.space.unit), region) if region else None
        left = tree.grow(margins, progress)
        tops = NodeRows(*(np.concatenate(columns) for columns in zip(*(rows for _, rows in left), strict=True)))
        count = len(tops.number)
        nodes, links, number, parents = tree.finish(tops, drawn_splats(pending))
    waits = np.repeat(np.array([level for level, _ in left], np.int32), [len(rows.number) for _, rows in left])
    family = np.full(len(links), NO_FAMILY, np.int64)
    is_given = number != MERGED
    family[is_given] = pending["family"][given[number[is_given]]]
    family[parents] = (np.int64(stage) << STAGE_BITS) | np.arange(len(parents))
    # A splat that waits for the level of its own size has not joined.
    is_new = (tops.children == 0) & (tops.number < (ends[-1] if len(ends) else 0))
    is_new[is_new] = np.searchsorted(ends, tops.number[is_new], "right") == waits[is_new]
    index = np.full(count, -1, np.int64)
    index[is_new] = pending["index"][given[tops.number[is_new]]]
    rest = {name: column.copy() for name, column in vars(nodes.take(slice(count))).items()}
    rest |= {"rows": tops.node, "level": np.where(is_new, np.int32(NEW), waits), "index": index}
    batches, with_children = tree.batches[::-1], nodes.take(parents)
    coarse_first = np.array([LEVELS - level for level, *_ in batches], np.int32)
    families = StageFamilies(
        batch=np.repeat(coarse_first, [count for _, count, *_ in batches]),
        key=np.concatenate([*(keys for *_, keys in batches), np.empty((0, plan.parts(0).words), np.uint64)]),
        count=links.child_count[parents],
        nodes=nodes.take(slice(count, None)),
        family=family[count:],
        center=with_children.center,
        size=spark_size(with_children),
    )
    return families, {**rest, "family": family[:count].copy()}


def _tree(pending: Pending, grid: VoxelGrid, threads: int) -> tuple[VoxelTree, Nodes, Offsets]:
    """Return the forest of a stage, the pending node of each number, and the end of each level among the new splats.

    New splats have the first numbers, by level, curve and index, as in memory; then come other splats, then merged
    nodes. Takes "rows" out of `pending`, so that they are freed once all splats have joined.
    """
    is_new = pending["level"] == NEW
    new, old = (np.flatnonzero(mask).astype(np.uint32) for mask in (is_new, ~is_new))
    index, order = pending["index"][new], None
    if (np.diff(index) < 0).any():
        order = np.arange(len(new), dtype=np.uint32)
        order = sort_by_key(index.astype(np.uint64), order, int(index.max()).bit_length(), threads)[1]
    center, scale = (pending[name][new] if len(old) else pending[name] for name in ("center", "scale"))
    order, ends = grid.sorted_leaves(center, scale, threads, order)
    new = new[order]
    is_merged = pending["family"][old] != NO_FAMILY
    leaf_count = len(new) + int(np.count_nonzero(~is_merged))
    place = old
    old = np.concatenate([old[~is_merged], old[is_merged]])
    numbers = np.arange(len(new), len(new) + len(old), dtype=np.uint32)
    rows: FloatArray = pending.pop("rows")
    survivors = NodeRows(rows[old], numbers, np.zeros(len(old), np.uint16))
    number = np.empty(len(old), np.uint32)  # of each survivor, in the order of the stages
    number[np.searchsorted(place, old)] = np.arange(len(old), dtype=np.uint32)
    levels = pending["level"][place]
    waiting = {level: survivors.take(number[levels == level]) for level in np.unique(levels).tolist()}
    given = np.concatenate([new, old])
    return VoxelTree(grid, leaf_count, given, ends, rows, waiting), given, ends
