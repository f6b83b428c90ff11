"""The order of nodes in a file that is read whole: from coarse to fine in few bands, each of them along the tree.

Neighbours in a file compress together if they are neighbours in space. A builder's order goes through the scene once
for each step of size; this one goes through it once a band, from subtree to subtree. At the end of each band the nodes
up to there are an even, coarser scene. docs/decisions/2026-11-22-size.md has what that saves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from .families import families_of, placed, taken
from .kernels.family_links import find_limits

#: Nodes of the first band, and how many times more there are at the end of each band than at that of the one before.
#: Measured: with 8 instead of 4 files are up to 0.5 % smaller, and in no bands up to 0.9 %, but fewer prefixes are even
#: scenes then (docs/decisions/2026-11-22-size.md).
FIRST_BAND, BAND_GROWTH = 4096, 4

Index = NDArray[np.int32]


def banded(built: list[tuple[Splats, LodTree]]) -> tuple[Splats, LodTree]:
    """The same tree with its nodes in bands.

    The root is node 0, siblings are consecutive, in the order that they had, and come after their parent. The result
    does not depend on the number of threads.

    Args:
        built: M nodes, a parent before its children, and their tree; the list is emptied, see `families.taken`.
    """
    nodes, tree = built[0]
    families, parent = families_of(tree)
    parents = families[band_order(parent, tree.child_count[families], spark_size(nodes)[families])]
    del nodes
    return taken(built, *placed(tree, parents))


def band_order(parent: Index, count: NDArray[np.uint16], size: FloatArray) -> Index:
    """The order of families of which `banded` speaks.

    Args:
        parent: (F,) for each node that has children, in the order of the nodes, the place here of its parent; -1 for
            the root.
        count: (F,) number of its children.
        size: (F,) its feature size, world units.

    Returns:
        (F,) int32 places here, in the order in which the children are written.
    """
    if not len(parent):
        return np.empty(0, np.int32)
    depth, limit = find_limits(parent, np.fmax(size, np.float32(0)))
    levels = _levels(depth)
    by_size = np.argsort(-limit, kind="stable")  # parents first, where they are as large
    band = np.empty(len(parent), np.int32)
    before = np.cumsum(count[by_size], dtype=np.int64) - count[by_size]
    ends = [FIRST_BAND * BAND_GROWTH**k for k in range(max(1, math.ceil(math.log2(len(before)))) + 1)]
    band[by_size] = np.searchsorted(ends, before, side="right")
    return np.lexsort((_depth_first(parent, levels), band)).astype(np.int32)


def _levels(depth: Index) -> list[NDArray[np.int64]]:
    """The families of each depth, ascending."""
    return np.split(np.argsort(depth, kind="stable"), np.cumsum(np.bincount(depth))[:-1])


def _depth_first(parent: Index, levels: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """(F,) the place of each family where those below it follow it at once, in their order."""
    below = np.ones(len(parent), np.int64)  # families of each subtree
    for level in levels[:0:-1]:
        np.add.at(below, parent[level], below[level])
    ends = np.cumsum(below)
    starts = ends - below
    # Families of siblings are one after the other.
    first = np.flatnonzero(np.diff(parent, prepend=-2))
    starts -= np.repeat(starts[first], np.diff(first, append=len(parent)))
    for level in levels[1:]:
        starts[level] += starts[parent[level]] + 1
    return starts
