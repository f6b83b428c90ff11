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
from .kernels.sort import Nodes, sort_by_cell
from .margins import Margins
from .voxel_grid import VoxelGrid
from .voxel_tree import Joining, Rows, VoxelTree


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
    waiting: dict[int, Rows] = field(default_factory=dict)


def grow(
    tree: VoxelTree, grid: VoxelGrid, arrivals: Arrivals, margins: Margins | None, progress: Progress
) -> list[tuple[int, Rows]]:
    """Merges the nodes of each cell, level by level.

    Args:
        tree: without nodes.
        grid: of the scene.
        arrivals: all nodes that are given; it is emptied.
        margins: of the region that they are in, at level 0; None if they are all that there are, and get one root.
        progress: told of the splats that have joined.

    Returns:
        the nodes without a parent, by the level that they wait for; only the root if there are no margins.
    """
    active, level, joined = np.empty(0, np.uint32), 0, 0
    left: list[tuple[int, Rows]] = []
    while True:
        if level in arrivals.waiting:
            active = tree.join(active, arrivals.waiting.pop(level))
            active = _by_cell(tree, grid, level - 1, active, within=False)[0]
        if level > grid.last_level and not arrivals.waiting and len(active) <= 1:
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
            active, outside = margins.split(active, tree.nodes)
            left.append((level, tree.take(outside)))
        if len(active) > 1:
            with threads_for(len(active)):
                active = tree.tidy(active)
                active = tree.merge_cells(level, *_by_cell(tree, grid, level, active), grid.largest_trace(level))
        level += 1
    left.append((level, tree.take(active)))
    unjoined = [(level, splats.rows()) for level, splats in arrivals.joining.items()]
    return left + unjoined + list(arrivals.waiting.items())


def _by_cell(
    tree: VoxelTree, grid: VoxelGrid, level: int, nodes: Nodes, *, within: bool = True
) -> tuple[Nodes, NDArray[np.bool_]]:
    """`sort_by_cell` of the cells of a level."""
    with threads_for(len(nodes)) as threads:
        return sort_by_cell(tree.nodes, nodes, grid.parts(level), threads, within=within)
