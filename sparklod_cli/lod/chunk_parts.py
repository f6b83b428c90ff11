"""Parts of a tree whose families are put in order one part after the other, where all at once take too much memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..model.splats import FloatArray
from ..support.parallel import blocks_of

Index = NDArray[np.int32]

#: Families that are looked at together on the way up the tree. Chosen.
_ROWS = 1 << 16


def parts_of(parent: Index, center: FloatArray, limit: FloatArray, most: int) -> Iterator[Index]:
    """All families in parts of at most `most`, of which none comes before the one that has its parent.

    The largest families are the first part. What is left are subtrees below them: those that are near each other are
    parts together, and one that is too large is divided like the tree. All of it takes some 40 bytes a family.

    Args:
        parent: (F,) int32 the family that has each one's parent, which comes before it; -1 for that of the root.
        center: (F, 3) of the parents.
        limit: (F,) the least size from the root to the parent.
        most: at least 1.

    Yields:
        (n,) int32 families, ascending.
    """
    yield from _divided(parent, center, limit, np.arange(len(parent), dtype=np.int32), most)


def _divided(parent: Index, center: FloatArray, limit: FloatArray, members: Index, most: int) -> Iterator[Index]:
    """Parts of the members, ascending, of a tree or a subtree."""
    if len(members) <= most:
        yield members
        return
    largest = _largest(limit[members], most)
    yield members[largest]
    rest = members[~largest]
    roots, of_root, weight = np.unique(_roots(parent, rest), return_inverse=True, return_counts=True)
    group = np.empty(len(roots), np.int32)
    for number, some in enumerate(_neighbours(center[rest[roots]], weight, np.arange(len(roots)), most)):
        group[some] = number
    of_family = group[of_root]
    order = np.argsort(of_family, kind="stable")
    for found in np.split(rest[order], np.cumsum(np.bincount(of_family))[:-1]):
        yield from _divided(parent, center, limit, found, most)


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
        while not np.array_equal(higher := root[root[part]], root[part]):
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
