"""Families, the children of one node each: what an order of nodes is made of, and a tree in an order of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model.lod_tree import LodTree
from ..model.splats import FloatArray, Splats
from ..support.jit import threads_in_use
from ..support.parallel import for_blocks
from .kernels.tree_links import find_parents


def families_of(tree: LodTree) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """The nodes that have children, and the parents of these.

    Returns:
        (F,) uint32 nodes, ascending, and (F,) int32 for each the place here of its parent; -1 for the root.
    """
    nodes = np.flatnonzero(tree.child_count).astype(np.uint32)
    number = np.full(len(tree), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    above, _ = find_parents(tree.child_count, tree.child_start)
    return nodes, np.where(above[nodes] < 0, np.int32(-1), number[above[nodes]])


def placed(tree: LodTree, parents: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """The order of nodes in which the root comes first, and then families.

    Args:
        tree: of M nodes.
        parents: (F,) the nodes that have children, in the order of these, each after the family that it is in.

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


def taken(
    built: list[tuple[Splats, LodTree]], order: NDArray[np.uint32], child_start: NDArray[np.uint32]
) -> tuple[Splats, LodTree]:
    """A tree in the order of `placed`.

    Args:
        built: the tree; the list is emptied, so that columns are freed one by one where nobody else holds them.
        order, child_start: of `placed`.
    """
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

    for_blocks(copy, len(order), threads_in_use(), lambda done: None)
    return found
