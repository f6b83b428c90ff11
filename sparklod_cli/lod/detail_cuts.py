"""The detail levels of a tree: cuts that do not depend on a camera, each a refinement of the coarser ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.splats import Splats
from .detail_order import losses
from .kernels.tree_links import find_parents

#: Without given shares, each level has this share of the splats of the level before. A viewer goes one level coarser
#: with each factor of its own in distance, by default 3 in PlayCanvas's engine: a surface then covers a ninth of the
#: pixels, so that levels of a quarter still have twice as many splats a pixel as the one before. All coarser levels
#: together are a third of full detail. Chosen.
STEP = 0.25

#: Without given shares, levels are added until one has no more splats than this: what a viewer loads first, and draws
#: at least. Chosen.
COARSE_ENOUGH = 1 << 16

Nodes = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class DetailCuts:
    """The nodes of each detail level.

    Attributes:
        nodes: (n,) int64 ascending, those of each level; level 0 has the leaves.
        parent: (M,) int32 parent of each node, -1 of the root.
    """

    nodes: list[Nodes]
    parent: NDArray[np.int32]

    @property
    def coarsest(self) -> Nodes:
        """The nodes of the last level."""
        return self.nodes[-1]

    def owners(self) -> NDArray[np.int64]:
        """(M,) the place in `coarsest` of the ancestor that is there, or of the node itself; -1 above the coarsest."""
        above = np.maximum(self.parent, 0).astype(np.int64)
        above[self.coarsest] = self.coarsest
        while True:  # each round doubles the number of edges that are gone up
            higher = above[above]
            if np.array_equal(higher, above):
                break
            above = higher
        place = np.full(len(self.parent), -1, np.int64)
        place[self.coarsest] = np.arange(len(self.coarsest))
        owner: NDArray[np.int64] = place[above]
        return owner


def shares_of(levels: Sequence[float] | None, leaves: int) -> list[float]:
    """The shares of the levels after full detail: those given, or such that suit a scene of so many splats.

    Raises:
        ValueError: they do not descend, or are not between 0 and 1.
    """
    if levels is None:
        shares = [STEP]
        while shares[-1] * leaves > COARSE_ENOUGH:
            shares.append(shares[-1] * STEP)
        return shares
    shares = list(levels)
    if not all(a > b for a, b in zip([1.0, *shares], [*shares, 0.0], strict=True)):
        raise ValueError(f"shares of detail levels must descend, above 0 and below 1; got {shares}")
    return shares


def detail_cuts(nodes: Splats, tree: LodTree, shares: Sequence[float]) -> DetailCuts:
    """Cuts of a tree with shares of its leaves, rounded, never more and less by at most the children of a node.

    Nodes are refined in the order of their losses (see `detail_order.losses`), which do not grow from a node to its
    children; one order for all cuts, so that each refines the coarser ones.

    Args:
        nodes: M splats, final order.
        tree: of them.
        shares: of each level after full detail, descending, between 0 and 1.
    """
    parent, _ = find_parents(tree.child_count, tree.child_start)
    loss = losses(nodes, tree, parent)
    inner = np.flatnonzero(~tree.is_leaf)
    order = inner[np.argsort(-loss[inner], kind="stable")]  # parents come first among equals, too
    turn = np.full(len(tree), len(order), np.int64)  # the number of nodes refined before it, leaves after all
    turn[order] = np.arange(len(order))
    turn_of_parent = np.where(parent >= 0, turn[np.maximum(parent, 0)], -1)
    splats = 1 + np.cumsum(tree.child_count[order].astype(np.int64) - 1)
    leaves = len(tree) - len(inner)
    found = [np.flatnonzero(tree.is_leaf)]
    for share in shares:
        refined = int(np.searchsorted(splats, round(share * leaves), side="right"))
        found.append(np.flatnonzero((turn_of_parent < refined) & (turn >= refined)))
    return DetailCuts(found, parent)
