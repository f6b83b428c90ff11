"""Quick-LoD: a tree of merged splats from voxel grids that grow by a constant factor.

The method is Spark's ("Quick LoD algorithm"). A splat of size s = 2 * max(scale) belongs to level ceil(log_base(s)),
whose cells have edges of base ** level. From the finest level up, the splats of a level join the survivors of the level
below, and all that share a cell become the children of one merged node.

For speed, leaves are sorted once, by level and Morton code, into rows with all data that a merge reads, so that each
level reads neighbouring memory. A level is a radix sort of its cells and one parallel merge. As the nodes of a level
are made in Morton order, writing the levels out backwards gives the final order, coarse before fine.
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
from .check import check, check_setting
from .kernels.final_order import fill_geometry, fill_leaves, final_indices, merge_colors
from .kernels.geometry import CENTER, WIDTH, SplatColumns, gather_rows
from .kernels.group import level_keys, split_cells
from .kernels.merge import merge_groups
from .kernels.sort import Nodes, sort_by_cell, sort_by_key

#: Largest cell coordinate: they are int64, and their differences must be, too. No level is finer than this allows.
MAX_CELL = 2.0**61

#: Bits per axis of the Morton codes that leaves are sorted by: 51 bits, and at most 11 for the level (sizes are
#: float32, the base is at least 1.1), fit a uint64.
CURVE_BITS = 17

#: Factor for the scales of merged splats: the profile of a splat with D above 1 is wider than its scale, and tails of
#: neighbours add up. Measured: 0.95 gains up to 0.7 dB over 1 (docs/decisions/2026-11-21-fidelity.md).
SHRINK = np.float32(0.95)

Offsets = NDArray[np.int64]


@dataclass
class _VoxelTree:
    """The tree while it is built: node rows, leaves first, and batches of merges.

    Attributes:
        geometry: (capacity, WIDTH) float32 rows of `kernels/geometry.py`.
        weight: (capacity,) float64, opacity * area.
        leaves: number of leaves.
        used: number of nodes so far.
        batches: merges that were done together: the first new node, the (C,) members, and (G + 1,) where the members of
            each new node begin. Members are leaves or from earlier batches.
    """

    geometry: FloatArray
    weight: NDArray[np.float64]
    leaves: int
    used: int
    batches: list[tuple[int, Nodes, Offsets]]

    def merge(self, members: Nodes, first: Offsets) -> None:
        """Merges each group of members into one node."""
        if len(first) > 1:
            merge_groups(members, first, self.geometry, self.weight, self.used)
            self.batches.append((self.used, members, first))
            self.used += len(first) - 1

    def merge_cells(self, nodes: Nodes, is_first: NDArray[np.bool_]) -> Nodes:
        """Merges the nodes of each cell with more than one; returns the node that each cell then has."""
        members, first, survivors = split_cells(nodes, is_first, self.used)
        while len(first) > 1 and np.diff(first).max() > MAX_CHILDREN:
            before = self.used
            members, first = self._fold_oversized(members, first)
            survivors[survivors >= before] += self.used - before
        self.merge(members, first)
        return survivors

    def _fold_oversized(self, members: Nodes, first: Offsets) -> tuple[Nodes, Offsets]:
        """Groups members of oversized groups into intermediate nodes of equal shares, at most MAX_CHILDREN each."""
        count = np.diff(first)
        big = np.flatnonzero(count > MAX_CHILDREN)
        shares = [np.linspace(0, count[g], -(-count[g] // MAX_CHILDREN) + 1).astype(np.int64) for g in big]
        made = np.arange(sum(len(share) - 1 for share in shares), dtype=np.uint32) + np.uint32(self.used)
        starts, parts, at, done = [np.zeros(1, np.int64)], [], 0, 0
        for g, share in zip(big, shares, strict=True):
            starts.append(starts[-1][-1] + share[1:])
            parts += [members[at : first[g]], made[done : done + len(share) - 1]]
            at, done = first[g + 1], done + len(share) - 1
        self.merge(np.concatenate([members[first[g] : first[g + 1]] for g in big]), np.concatenate(starts))
        count[big] = [len(share) - 1 for share in shares]
        return np.concatenate([*parts, members[at:]]), np.concatenate([[0], np.cumsum(count)])


def build(splats: Splats, base: float = DEFAULT_BASE, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree.

    The result does not depend on the number of threads (`support.threads`). Each input splat is one leaf, bit for bit.
    The root is node 0, siblings are consecutive and come after their parent. Any prefix of the nodes is a coarser
    scene: nodes whose parents were made at a coarser level come first, and along a Morton curve within a level.

    Args:
        splats: N splats, finite, with positive opacity and at least one positive scale each.
        base: growth of the cells from level to level, 1.1 to 2.0.
        progress: called with the number of splats that have joined the tree.

    Returns:
        M >= N splats and their tree; merged ones have linear opacities up to 1000.

    Raises:
        InvalidSplatsError: there are no splats, or one is invalid or invisible.
        ValueError: the base is out of range.
    """
    check_setting("base", base, MIN_BASE, MAX_BASE)
    n = len(splats)
    bounds = check(splats)
    low, high = bounds.low, bounds.high
    with threads_for(n) as threads:
        finest = math.floor(math.log(max(bounds.smallest, np.abs([low, high]).max() / MAX_CELL), base))
        coarsest = max(finest + 1, math.ceil(math.log(bounds.largest, base)) + 1)
        steps = base ** np.arange(finest, coarsest + 1, dtype=np.float64)
        index, joins = _sort_leaves(splats, steps, low, high, threads)
        rows, weight = np.empty((2 * n, WIDTH), np.float32), np.empty(2 * n, np.float64)
        columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
        gather_rows(index, columns, rows, weight)
        rgb, sh = splats.rgb, splats.sh
        del splats, columns  # the rows have the rest; frees the memory if the caller has no reference
        voxel_tree = _VoxelTree(rows, weight, n, n, [])
        del rows
        _grow(voxel_tree, joins, base, finest, low, high, progress)
        return _in_final_order(voxel_tree, index, rgb, sh)


def _sort_leaves(
    splats: Splats, steps: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], threads: int
) -> tuple[Nodes, Offsets]:
    """The splat of each leaf, by level and then along a curve, and where each level ends."""
    grid = max(float((high - low).max()) / (2**CURVE_BITS - 2), float(steps[0]))  # one cell to spare at either end
    low_cell = np.floor(low / grid).astype(np.int64)
    level_bits = len(steps).bit_length()
    keys, levels = level_keys(splats.center, splats.scale, steps, grid, low_cell, 3 * CURVE_BITS)
    index = np.arange(len(splats), dtype=np.uint32)
    _, index = sort_by_key(keys, index, 3 * CURVE_BITS + level_bits, threads)
    return index, np.cumsum(np.bincount(levels, minlength=len(steps)))


def _grow(
    voxel_tree: _VoxelTree,
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
        if joined < voxel_tree.leaves:
            new = np.arange(joined, joins[level], dtype=np.uint32)
            active, joined = np.concatenate([active, new]), int(joins[level])
            progress("building", joined, voxel_tree.leaves, "splat")
        if len(active) > 1:
            # A mean is in the box of its terms, so the scene's box bounds the cells of all levels.
            low_cell = np.floor(low / step).astype(np.int64)
            axis_bits = int((np.floor(high / step).astype(np.int64) - low_cell).max()).bit_length()
            with threads_for(len(active)) as threads:
                cells = sort_by_cell(voxel_tree.geometry, active, step, low_cell, axis_bits, threads)
                active = voxel_tree.merge_cells(*cells)
        if joined == voxel_tree.leaves and len(active) <= 8:  # perhaps a block of 2 x 2 x 2 cells
            cell = np.floor(voxel_tree.geometry[active, CENTER : CENTER + 3] / step)
            if np.ptp(cell, axis=0).max() <= 1:
                break
        level += 1
    if len(active) > 1:
        voxel_tree.merge(active, np.array([0, len(active)]))


def _in_final_order(voxel_tree: _VoxelTree, index: Nodes, rgb: FloatArray, sh: FloatArray) -> tuple[Splats, LodTree]:
    """The root, then the members of the batches, last batch first.

    Colours are merged here, where those of siblings are adjacent.

    Args:
        voxel_tree: the tree.
        index: (N,) splat of each leaf.
        rgb, sh: of the splats.
    """
    total = voxel_tree.used
    order = np.empty(total, np.uint32)
    order[0] = total - 1
    end = total
    for _, members, _ in voxel_tree.batches:
        order[end - len(members) : end] = members
        end -= len(members)
    final = final_indices(order, voxel_tree.leaves)
    tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
    out = Splats.empty(total, degree_of(sh.shape[1]))
    geometry = out.center, out.scale, out.quat_xyzw, out.opacity
    fill_geometry(order, voxel_tree.geometry, voxel_tree.leaves, SHRINK, *geometry)
    voxel_tree.geometry = np.empty((0, WIDTH), np.float32)  # frees memory for the colours
    flat_sh = out.sh.reshape(total, -1)
    fill_leaves(order, index, rgb, out.rgb)
    fill_leaves(order, index, sh.reshape(len(sh), -1), flat_sh)
    end = total
    for row, members, first in voxel_tree.batches:
        parents = final[row - voxel_tree.leaves :][: len(first) - 1]
        end -= len(members)
        tree.child_start[parents] = end + first[:-1]
        tree.child_count[parents] = np.diff(first)
        with threads_for(len(members)) as threads:
            for color in (out.rgb, flat_sh):
                merge_colors(parents, tree.child_start, tree.child_count, order, voxel_tree.weight, color, threads)
    return out, tree
