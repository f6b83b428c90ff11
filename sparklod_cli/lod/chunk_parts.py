"""Parts of a tree that are put in order one after the other, where all families at once take too much memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from ..support.parallel import blocks_of

Index = NDArray[np.int32]

#: Families that are looked at together on the way up the tree. Chosen.
_ROWS = 1 << 16


@dataclass(frozen=True, eq=False)
class FamilyTree:
    """The families of a tree, in ascending order of the nodes whose children they are: F of them.

    Attributes:
        parent: (F,) int32 the family that has that node; -1 for that of the root's children.
        count: (F,) of any unsigned type, its nodes.
        center: (F, 3) float32 of that node, world units.
        size: (F,) float32 feature size of that node, as `model.gaussian.spark_size` has it.
    """

    parent: Index
    count: NDArray[np.unsignedinteger]
    center: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.parent)

    def limits(self) -> FloatArray:
        """(F,) the least size from the root to each family's parent; 0 for what is not a number."""
        limit: FloatArray = np.fmax(self.size, np.float32(0))
        for part in blocks_of(len(self), _ROWS):
            here, above = limit[part], self.parent[part].copy()
            while (below := np.flatnonzero(above >= 0)).size:  # each round goes twice as far up within the block
                ancestor = above[below]
                here[below] = np.minimum(here[below], limit[ancestor])
                inside = ancestor >= part.start
                above[below] = np.where(inside, above[np.where(inside, ancestor - part.start, 0)], -1)
        return limit


def parts_of(tree: FamilyTree, limit: FloatArray, members: Index, most: int) -> Iterator[Index]:
    """Members in parts of at most `most` families, of which none comes before the family of its parent.

    The largest families are the first part. What is left are subtrees below them: those that are near each other are
    parts together, and one that is too large is divided like a tree.

    Args:
        tree: its families.
        limit: of `FamilyTree.limits`.
        members: of a tree or a subtree, ascending.
        most: at least 1.
    """
    if len(members) <= most:
        yield members
        return
    largest = _largest(limit[members], most)
    yield members[largest]
    rest = members[~largest]
    root = _roots(tree.parent, rest)
    roots, of_root, weight = np.unique(root, return_inverse=True, return_counts=True)
    group = np.empty(len(roots), np.int32)
    for number, some in enumerate(_neighbours(tree.center[rest[roots]], weight, np.arange(len(roots)), most)):
        group[some] = number
    of_family = group[of_root]
    order = np.argsort(of_family, kind="stable")
    for found in np.split(rest[order], np.cumsum(np.bincount(of_family))[:-1]):
        yield from parts_of(tree, limit, found, most)


def _largest(limit: FloatArray, most: int) -> NDArray[np.bool_]:
    """(N,) which are the `most` largest, fewer than N; of equal ones the first, which are not below the others."""
    least = np.partition(limit, len(limit) - most)[len(limit) - most]
    found: NDArray[np.bool_] = limit > least
    equal = np.flatnonzero(limit == least)
    found[equal[: most - int(np.count_nonzero(found))]] = True
    return found


def _roots(parent: Index, members: Index) -> Index:
    """(N,) the place, among ascending members, of the highest of each member's ancestors that are members."""
    above = parent[members]
    at = np.minimum(np.searchsorted(members, above), len(members) - 1).astype(np.int32)
    root = np.where(members[at] == above, at, np.arange(len(members), dtype=np.int32))
    for part in blocks_of(len(root), _ROWS):
        while (higher := root[root[part]]).tobytes() != root[part].tobytes():
            root[part] = higher
    return root


def _neighbours(
    center: FloatArray, weight: NDArray[np.int64], some: NDArray[np.int64], most: int
) -> Iterator[NDArray[np.int64]]:
    """Subtrees in groups of at most `most` families, unless one has more; halved where they are spread most."""
    if len(some) == 1 or weight[some].sum() <= most:
        yield some
        return
    axis = int(np.ptp(center[some], axis=0).argmax())
    ordered = some[np.argsort(center[some, axis], kind="stable")]
    until = np.cumsum(weight[ordered])
    middle = min(max(1, int(np.searchsorted(until, until[-1] / 2))), len(some) - 1)
    yield from _neighbours(center, weight, ordered[:middle], most)
    yield from _neighbours(center, weight, ordered[middle:], most)
