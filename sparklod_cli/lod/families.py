"""Families, the children of one node each; trees in an order of them; and the order for files that are read whole.

That order goes from coarse to fine in few bands, each of them along the tree. Neighbours in a file compress together if
they are neighbours in space. A builder's order goes through the scene once for each step of size; this one goes through
it once a band, from subtree to subtree. At the end of each band the nodes up to there are an even, coarser scene.
benchmarks/notes/file-sizes.md has what that saves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..model.gaussian import spark_size
from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..system.threads import for_blocks, threads_in_use
from .kernels.tree_links import find_limits, find_parents

#: Nodes of the first band, and how many times more there are at the end of each band than at that of the one before.
#: Measured: with 8 instead of 4 files are up to 0.5 % smaller, and in no bands up to 0.9 %, but fewer prefixes are even
#: scenes then (benchmarks/notes/file-sizes.md).
FIRST_BAND, BAND_GROWTH = 4096, 4
Index = NDArray[np.int32]


def families_of(tree: LodTree) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """Return (F,) uint32 nodes with children, ascending, and (F,) int32 places of their parents, -1 for the root."""
    nodes = np.flatnonzero(tree.child_count).astype(np.uint32)
    number = np.full(len(tree), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    above, _ = find_parents(tree.child_count, tree.child_start)
    return nodes, np.where(above[nodes] < 0, np.int32(-1), number[above[nodes]])


def node_order(tree: LodTree, parents: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the order in which the root comes first, and then the families of (F,) `parents`.

    Returns:
        (M,) uint32 the node at each place, and (M,) uint32 the `child_start` of each place.
    """
    total = len(tree)
    order, child_start = np.zeros(total, np.uint32), np.zeros(total, np.uint32)
    if not len(parents):
        return order, child_start
    count = tree.child_count[parents].astype(np.int64)
    first = np.cumsum(count) - count
    order[1:] = np.repeat(tree.child_start[parents] - first, count) + np.arange(total - 1)
    place = np.empty(total, np.uint32)
    place[order] = np.arange(total, dtype=np.uint32)
    child_start[place[parents]] = first + 1
    return order, child_start


def reordered(
    built: list[tuple[Splats, LodTree]], order: NDArray[np.uint32], child_start: NDArray[np.uint32]
) -> tuple[Splats, LodTree]:
    """Return a tree in the order of `node_order`; `built` is emptied, so that columns are freed one by one."""
    nodes, tree = built.pop()
    columns = dict(vars(nodes))
    del nodes
    for name in columns:
        columns[name] = _rows(columns[name], order)
    return Splats(**columns), LodTree(tree.child_count[order], child_start)


def _rows(column: FloatArray, order: NDArray[np.uint32]) -> FloatArray:
    """`column[order]`, copied on the threads of kernels."""
    found = np.empty((len(order), *column.shape[1:]), column.dtype)

    def copy(part: slice) -> None:
        # "clip" lets numpy write to `found` at once; with its default it has a copy of its own.
        np.take(column, order[part], axis=0, out=found[part], mode="clip")

    for_blocks(copy, len(order), threads_in_use())
    return found


def banded(built: list[tuple[Splats, LodTree]]) -> tuple[Splats, LodTree]:
    """Return the same tree with its nodes in bands.

    The root is node 0, siblings are consecutive, in the order that they had, and come after their parent. The result
    does not depend on the number of threads. `built` is emptied, see `reordered`.
    """
    nodes, tree = built[0]
    families, parent = families_of(tree)
    parents = families[band_order(parent, tree.child_count[families], spark_size(nodes)[families])]
    del nodes
    return reordered(built, *node_order(tree, parents))


def band_order(parent: Index, count: NDArray[np.uint16], size: FloatArray) -> Index:
    """Return the order of families of `banded`: (F,) int32 places, in the order in which the children are written.

    Args:
        parent: (F,) for each node that has children, in the order of the nodes, the place here of its parent; -1 for
            the root.
        count, size: (F,) number of children and feature size of each.
    """
    if not len(parent):
        return np.empty(0, np.int32)
    depth, limit = find_limits(parent, np.fmax(size, np.float32(0)))
    levels = np.split(np.argsort(depth, kind="stable"), np.cumsum(np.bincount(depth))[:-1])
    by_size = np.argsort(-limit, kind="stable")  # parents first, where they are as large
    band = np.empty(len(parent), np.int32)
    before = np.cumsum(count[by_size], dtype=np.int64) - count[by_size]
    ends = [FIRST_BAND * BAND_GROWTH**k for k in range(max(1, math.ceil(math.log2(len(before)))) + 1)]
    band[by_size] = np.searchsorted(ends, before, side="right")
    return np.lexsort((_depth_first(parent, levels), band)).astype(np.int32)


def _depth_first(parent: Index, levels: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the (F,) place of each family where those below it follow it at once, in their order."""
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
