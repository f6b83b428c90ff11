"""Detail levels of a tree: cuts of it, region by region, in plain splats."""

from __future__ import annotations

import numpy as np

from ..model.lod_tree import LodTree
from ..model.scene import DetailScene
from ..model.splats import Splats
from ..support.progress import Progress, silent
from .detail_cuts import detail_cuts, shares_of
from .detail_settings import DetailSettings
from .plain_opacity import with_plain_opacity
from .regions import Places, divide, extents, united


def make(nodes: Splats, tree: LodTree, settings: DetailSettings, *, progress: Progress = silent) -> DetailScene:
    """The detail levels of a scene, from its tree.

    Level 0 has the leaves, bit for bit if their opacity is at most 1. Each further level is a cut of the tree that the
    finer levels refine. A region is a set of nodes of the coarsest level, and all that is below them: at every level it
    stands for the same leaves, and no leaf is in two regions. The result does not depend on the number of threads.

    Args:
        nodes: M splats, those of a tree in final order.
        tree: of them.
        settings: shares of the levels and sizes of regions. A region that is a single node of the coarsest level is not
            divided, whatever its size.
        progress: called with the number of levels done in the stage dividing.

    Returns:
        the scene, without errors; within a run, splats are in the order of the tree.

    Raises:
        ValueError: the shares do not descend, or are not between 0 and 1.
    """
    leaves = int(np.count_nonzero(tree.is_leaf))
    shares = shares_of(settings.levels, leaves)
    levels = len(shares) + 1
    progress("dividing", 0, levels, "level")
    cuts = detail_cuts(nodes, tree, shares)
    owner = cuts.owners()
    order = np.concatenate(cuts.nodes)
    owner = owner[order]
    under = len(cuts.coarsest)
    center = nodes.center[order]
    box = united(np.stack([center, center], axis=1), owner, under)
    places = Places(nodes.center[cuts.coarsest], box, np.bincount(owner, minlength=under))
    regions = divide(places, settings)
    region = regions.number[owner]
    count = int(regions.number.max()) + 1
    level = np.repeat(np.arange(levels), [len(some) for some in cuts.nodes])
    key = level * count + region
    splats = with_plain_opacity(nodes.take(order[np.argsort(key, kind="stable")]))
    counts = np.bincount(key, minlength=levels * count).reshape(levels, count).T
    bounds = united(extents(splats), np.sort(key) % count, count)
    progress("dividing", levels, levels, "level")
    return DetailScene(splats, np.ascontiguousarray(counts), bounds, regions.children)
