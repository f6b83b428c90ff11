"""Grows the tree of the quick builder level by level, of all nodes of a scene or of those in a region of it.

Of a region, only cells get a node that no other node of the scene can be in; what lies in the others is left. Where
unknown nodes will be merged is unknown, too, but in the cells that their members lie in: a mean lies between its terms,
and float32 rounds it no further. So what is unknown at a level ends where the cells of the level below end that
something unknown could be in.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..support.jit import threads_for
from ..support.progress import Progress
from .kernels.geometry import CENTER
from .kernels.sort import Nodes, sort_by_cell
from .margins import Margins
from .voxel_grid import VoxelGrid
from .voxel_tree import Offsets, VoxelTree

#: The last nodes get one parent: no more of them than these, which may be a block of 2 x 2 x 2 cells.
LAST_NODES = 8


@dataclass(frozen=True, eq=False)
class Arrivals:
    """The level from which on each of the given nodes is active.

    Attributes:
        joins: (L,) where the splats that join at each level end among the rows, which begin with them.
        waiting: (W,) rows of survivors by the level that they wait for. Each of them has a cell of the level below for
            itself.
        waits: where those that wait for each level end in `waiting`.
    """

    joins: Offsets
    waiting: Nodes = field(default_factory=lambda: np.empty(0, np.uint32))
    waits: Offsets = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def splats(self) -> int:
        """The number of splats that join."""
        return int(self.joins[-1]) if len(self.joins) else 0

    def new(self, level: int) -> Nodes:
        """The splats that join at a level."""
        return np.arange(*_part(self.joins, level), dtype=np.uint32)

    def survivors(self, level: int) -> Nodes:
        """The survivors that wait for a level."""
        return self.waiting[slice(*_part(self.waits, level))]


def _part(ends: Offsets, level: int) -> tuple[int, int]:
    """Where the part of a level begins and ends."""
    if level >= len(ends):
        return 0, 0
    return int(ends[level - 1]) if level else 0, int(ends[level])


@dataclass(frozen=True, eq=False)
class Left:
    """Nodes without a parent.

    Attributes:
        nodes: rows of the tree.
        levels: the level that each of them waits for.
    """

    nodes: Nodes
    levels: NDArray[np.int32]


def grow(tree: VoxelTree, grid: VoxelGrid, arrivals: Arrivals, margins: Margins | None, progress: Progress) -> Left:
    """Merges the nodes of each cell, level by level.

    Args:
        tree: with the given nodes.
        grid: of the scene.
        arrivals: of the given nodes.
        margins: of the region that they are in, at level 0; None if they are all that there are, and get one root.
        progress: told of the splats that have joined.
    """
    active, level, last = np.empty(0, np.uint32), 0, grid.last_level
    left: list[tuple[int, Nodes]] = []
    while True:
        came = arrivals.survivors(level)
        if len(came):
            active = _by_cell(tree, grid, level - 1, np.concatenate([active, came]))[0]
        if level > last and level + 1 >= len(arrivals.waits) and _are_last(tree, active, grid.step(level - 1)):
            break
        if margins is not None:
            margins.widen(level)
            if margins.are_closed:
                break
        new = arrivals.new(level)
        if len(new):
            active = np.concatenate([active, new])
            progress("building", int(new[-1]) + 1, arrivals.splats, "splat")
        if margins is not None:
            active, waiting = margins.split(active, tree.geometry)
            left.append((level, waiting))
        if len(active) > 1:
            with threads_for(len(active)):
                active = tree.merge_cells(level, *_by_cell(tree, grid, level, active))
        level += 1
    if margins is None and len(active) > 1:
        tree.merge(level, 0, active, np.array([0, len(active)]))
        active = np.array([tree.used - 1], np.uint32)
    left.append((level, active))
    for later in range(level, max(len(arrivals.joins), len(arrivals.waits))):
        left.append((later, arrivals.new(later)))
        if later > level:
            left.append((later, arrivals.survivors(later)))
    levels = np.repeat(np.array([k for k, _ in left], np.int32), [len(nodes) for _, nodes in left])
    return Left(np.concatenate([nodes for _, nodes in left]), levels)


def _by_cell(tree: VoxelTree, grid: VoxelGrid, level: int, nodes: Nodes) -> tuple[Nodes, NDArray[np.bool_]]:
    """`sort_by_cell` of the cells of a level."""
    step, low_cell, axis_bits = grid.cells(level)
    with threads_for(len(nodes)) as threads:
        return sort_by_cell(tree.geometry, nodes, step, low_cell, axis_bits, threads)


def _are_last(tree: VoxelTree, nodes: Nodes, step: np.float64) -> bool:
    """Whether nodes lie in a block of 2 x 2 x 2 cells, so that they get one parent."""
    if len(nodes) > LAST_NODES:
        return False
    cell = np.floor(tree.geometry[nodes, CENTER : CENTER + 3].astype(np.float64) / step)
    return len(nodes) == 0 or bool(np.ptp(cell, axis=0).max() <= 1)
