"""Quick-LoD: a tree of merged splats from voxel grids that grow by a constant factor.

The method is Spark's ("Quick LoD algorithm"). A splat of size s = 2 * max(scale) belongs to level ceil(log_base(s)),
whose cells have edges of base ** level. From the finest level up, the splats that belong to a level join the survivors
of the level below, and all that share a cell become the children of one merged node.

How it is made fast: leaves are sorted once by level and Morton code into rows that hold all a merge reads, so that each
level reads neighbouring memory; a level is a radix sort of its cells and one parallel merge; and as the nodes of a
level are made in Morton order, writing the levels out backwards *is* the final order, coarse before fine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import MAX_CHILDREN, LodTree
from ..model.sh import degree_of
from ..model.splats import FloatArray, Splats
from ..support.defaults import DEFAULT_BASE, MAX_BASE, MIN_BASE
from ..support.jit import threads_for
from ..support.progress import Progress, silent
from .check import check
from .kernels.final_order import fill_columns, fill_leaves, merge_colors, places_of_merged
from .kernels.geometry import CENTER, WIDTH, fill_rows
from .kernels.group import level_keys, split_cells
from .kernels.merge import merge_groups
from .kernels.sort import Nodes, sort_by_cell, sort_by_key

#: Cells count in int64; the finest level is the first at which the scene's coordinates stay below this.
MAX_CELL = 2.0**61

#: Bits an axis of the curve that the leaves are sorted along; float32 sizes span 11 bits of levels, all fit a uint64.
CURVE_BITS = 17

#: Merged splats are drawn so much smaller than their moments say. The profile of one that is more than opaque is wider
#: than its scale, and tails of neighbours add up; 5 % is the best of what was measured over four scenes.
SHRINK = np.float32(0.95)

Offsets = NDArray[np.int64]


@dataclass
class _Forest:
    """The tree while it grows from its leaves: rows of `kernels/geometry.py`, leaves first, and who merged into whom.

    Attributes:
        geometry: (capacity, WIDTH) float32, weight: (capacity,) float64 opacity * area.
        leaves: rows that are leaves. used: rows that are filled.
        batches: what was merged at once: the first new row, the members (C,) and where each new row's members start
            (G + 1,). A batch's members are all in earlier batches.
    """

    geometry: FloatArray
    weight: NDArray[np.float64]
    leaves: int
    used: int
    batches: list[tuple[int, Nodes, Offsets]]

    def merge(self, members: Nodes, first: Offsets) -> None:
        """Makes one node of each group of members."""
        if len(first) > 1:
            merge_groups(members, first, self.geometry, self.weight, self.used)
            self.batches.append((self.used, members, first))
            self.used += len(first) - 1

    def merge_cells(self, nodes: Nodes, is_first: NDArray[np.bool_]) -> Nodes:
        """Merges the nodes of every cell that has more than one; returns the one that is left of each cell."""
        members, first, survivors = split_cells(nodes, is_first, self.used)
        while len(first) > 1 and np.diff(first).max() > MAX_CHILDREN:
            before = self.used
            members, first = self._fold_oversized(members, first)
            survivors[survivors >= before] += self.used - before
        self.merge(members, first)
        return survivors

    def _fold_oversized(self, members: Nodes, first: Offsets) -> tuple[Nodes, Offsets]:
        """Gives groups of more children than a node may have intermediate nodes, of equal shares, as children."""
        count = np.diff(first)
        big = np.flatnonzero(count > MAX_CHILDREN)
        shares = [np.linspace(0, count[g], -(-count[g] // MAX_CHILDREN) + 1).astype(np.int64) for g in big]
        made = np.arange(sum(len(share) - 1 for share in shares), dtype=np.uint32) + np.uint32(self.used)
        starts, kept, at, done = [np.zeros(1, np.int64)], [], 0, 0
        for g, share in zip(big, shares, strict=True):
            starts.append(starts[-1][-1] + share[1:])
            kept += [members[at : first[g]], made[done : done + len(share) - 1]]
            at, done = first[g + 1], done + len(share) - 1
        self.merge(np.concatenate([members[first[g] : first[g + 1]] for g in big]), np.concatenate(starts))
        count[big] = [len(share) - 1 for share in shares]
        return np.concatenate([*kept, members[at:]]), np.concatenate([[0], np.cumsum(count)])


def build(splats: Splats, base: float = DEFAULT_BASE, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree.

    The result does not depend on the number of threads (`jit.use_threads`). Every input splat is one leaf, bit for bit.
    Nodes come in an order in which the root is 0, children are consecutive and after their parent, and a prefix is a
    coarser scene: nodes whose parents were made at a coarser level come first, along a Morton curve inside a level.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        base: growth of the cells from level to level, 1.1 to 2.0.
        progress: told how many splats have joined the tree.

    Returns:
        M >= N splats and their tree; merged ones have linear opacities up to 1000.

    Raises:
        InvalidSplatsError: there is no splat, or one that cannot be drawn.
        ValueError: the base is out of range.
    """
    if not MIN_BASE <= base <= MAX_BASE:
        raise ValueError(f"base {base} is not within {MIN_BASE} to {MAX_BASE}")
    n = len(splats)
    found = check(splats)
    low, high = found.low, found.high
    with threads_for(n) as threads:
        finest = math.floor(math.log(max(found.smallest, np.abs([low, high]).max() / MAX_CELL), base))
        coarsest = max(finest + 1, math.ceil(math.log(found.largest, base)) + 1)
        steps = base ** np.arange(finest, coarsest + 1, dtype=np.float64)
        index, joins = _sort_leaves(splats, steps, low, high, threads)
        rows, weight = np.empty((2 * n, WIDTH), np.float32), np.empty(2 * n, np.float64)
        fill_rows(index, splats.center, splats.scale, splats.quat_xyzw, splats.opacity, rows, weight)
        rgb, sh = splats.rgb, splats.sh
        del splats  # from here on the rows have the rest; frees it where the caller has let go of it too
        forest = _Forest(rows, weight, n, n, [])
        del rows
        _grow(forest, joins, base, finest, low, high, progress)
        return _in_final_order(forest, index, rgb, sh)


def _sort_leaves(
    splats: Splats, steps: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], threads: int
) -> tuple[Nodes, Offsets]:
    """The order of the leaves, by natural level and then along a curve, and where each level ends in it."""
    grid = max(float((high - low).max()) / (2**CURVE_BITS - 2), float(steps[0]))
    low_cell = np.floor(low / grid).astype(np.int64)
    level_bits = len(steps).bit_length()
    keys, levels = level_keys(splats.center, splats.scale, steps, grid, low_cell, 3 * CURVE_BITS)
    index = np.arange(len(splats), dtype=np.uint32)
    _, index = sort_by_key(keys, index, 3 * CURVE_BITS + level_bits, threads)
    return index, np.cumsum(np.bincount(levels, minlength=len(steps)))


def _grow(
    forest: _Forest,
    joins: Offsets,
    base: float,
    finest: int,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    progress: Progress,
) -> None:
    """Merges cells level by level, up to one root."""
    active = np.empty(0, np.uint32)
    joined, level = 0, 0
    while True:
        step = np.float64(base) ** (finest + level)
        if joined < forest.leaves:
            new = np.arange(joined, joins[level], dtype=np.uint32)
            active, joined = np.concatenate([active, new]), int(joins[level])
            progress("building", joined, forest.leaves, "splat")
        if len(active) > 1:
            # A mean stays in the box of what it is a mean of, so the scene's own box bounds the cells of all levels.
            low_cell = np.floor(low / step).astype(np.int64)
            axis_bits = int((np.floor(high / step).astype(np.int64) - low_cell).max()).bit_length()
            with threads_for(len(active)) as threads:
                cells = sort_by_cell(forest.geometry, active, step, low_cell, axis_bits, threads)
                active = forest.merge_cells(*cells)
        if joined == forest.leaves and len(active) <= 8:  # a block of 2 x 2 x 2 cells with one survivor each
            cell = np.floor(forest.geometry[active, CENTER : CENTER + 3] / step)
            if np.ptp(cell, axis=0).max() <= 1:
                break
        level += 1
    if len(active) > 1:
        forest.merge(active, np.array([0, len(active)]))


def _in_final_order(forest: _Forest, index: Nodes, rgb: FloatArray, sh: FloatArray) -> tuple[Splats, LodTree]:
    """The root, then the members of the batches, last batch first; colours are merged here, where children are close.

    Args:
        index: (N,) splat of each leaf row.
        rgb, sh: of the splats.
    """
    total = forest.used
    order = np.empty(total, np.uint32)
    order[0] = total - 1
    end = total
    for _, members, _ in forest.batches:
        order[end - len(members) : end] = members
        end -= len(members)
    place = places_of_merged(order, forest.leaves)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    out = Splats.empty(total, degree_of(sh.shape[1]))
    fill_columns(order, forest.geometry, forest.leaves, SHRINK, out.center, out.scale, out.quat_xyzw, out.opacity)
    forest.geometry = np.empty((0, WIDTH), np.float32)  # the colours want its memory
    flat_sh = out.sh.reshape(total, -1)
    fill_leaves(order, index, rgb, out.rgb)
    fill_leaves(order, index, sh.reshape(len(sh), -1), flat_sh)
    end = total
    for row, members, first in forest.batches:
        parents = place[row - forest.leaves :][: len(first) - 1]
        end -= len(members)
        tree.child_start[parents] = end + first[:-1]
        tree.child_count[parents] = np.diff(first)
        with threads_for(len(members)) as threads:
            for color in (out.rgb, flat_sh):
                merge_colors(parents, tree.child_start, tree.child_count, order, forest.weight, color, threads)
    return out, tree
