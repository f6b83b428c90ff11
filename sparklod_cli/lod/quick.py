"""Quick-LoD: a tree of merged splats from voxel grids that grow by a constant factor.

The levels are those of Spark's method ("Quick LoD algorithm"): a splat of size s = 2 * max(scale) belongs to level
ceil(log_base(s)), and from the finest level up, the splats of a level join the survivors of the level below. There, all
nodes that share a cell become one. Here, cells are wider, and in each the cheapest pairs of neighbours merge for a few
rounds, up to a size that grows with the level; what became one node is a family (`kernels/cell_pairs.py`).
docs/decisions/2026-11-22-quick-again.md has the reasons, and the alternatives that were tried.

For speed, leaves are sorted once, by level and Morton code, into rows with all data that a merge reads, so that each
level reads neighbouring memory. A level is a radix sort of its cells and one parallel merge. As the nodes of a level
are made in Morton order, writing the levels out backwards gives the final order, coarse before fine.
"""

from __future__ import annotations

from ..model.lod_tree import LodTree
from ..model.splats import Splats
from ..support.defaults import DEFAULT_BASE, MAX_BASE, MIN_BASE
from ..support.jit import threads_for
from ..support.progress import Progress, silent
from .check import check, check_setting
from .voxel_grid import VoxelGrid
from .voxel_growth import Arrivals, grow
from .voxel_rows import fill_rows, joining, sorted_leaves
from .voxel_tree import VoxelTree


def build(splats: Splats, base: float = DEFAULT_BASE, *, progress: Progress = silent) -> tuple[Splats, LodTree]:
    """Builds a Level-of-Detail tree.

    The result does not depend on the number of threads. Each input splat is one leaf, bit for bit.
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
    with threads_for(n) as threads:
        grid = VoxelGrid.of(bounds, base)
        index, joins = sorted_leaves(splats.center, splats.scale, grid, threads)
        arrivals = Arrivals(n, joining(index, joins, lambda some, rows: fill_rows(some, splats, grid.space, rows)))
        tree = VoxelTree(n, n, grid.space)
        ((_, root),) = grow(tree, grid, arrivals, None, progress)
        final = tree.finish(root, index, splats)
    return final.nodes, final.tree
