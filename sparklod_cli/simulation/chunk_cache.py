"""Which chunks of trees are in memory: their numbers, their importance, and a cache that gives up the least used."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Chunks:
    """The chunks of all trees, numbered through: those of the first tree, then those of the second, and so on.

    These are the numbers of `lod.traversal.Forest.chunk_base`.

    Args:
        sizes: for each tree (chunks of it,) bytes in its file.

    Attributes:
        sizes: of each chunk, bytes.
        roots: the first chunk of each tree, which holds its root.

    Raises:
        ValueError: a tree without chunks, or a negative size.
    """

    def __init__(self, sizes: Sequence[ArrayLike]) -> None:
        self.sizes: list[int] = []
        self.roots: list[int] = []
        for tree, of_tree in enumerate(sizes):
            column = np.asarray(of_tree, np.int64)
            if column.ndim != 1 or not len(column) or column.min() < 0:
                raise ValueError(f"the chunks of tree {tree} are to be a list of sizes, 0 or more each")
            self.roots.append(len(self.sizes))
            self.sizes += column.tolist()

    def __len__(self) -> int:
        return len(self.sizes)

    def bytes_of(self, chunks: Iterable[int]) -> int:
        """The size of some chunks together."""
        return sum(self.sizes[chunk] for chunk in chunks)


def by_priority(chunks: NDArray[np.integer], pixel_scales: NDArray[np.floating]) -> list[int]:
    """Each chunk once, the most important first: that of the greatest pixel scale, of equal ones that of lower number.

    A node is never larger than its parent where pixel scales are limits of a cut (`lod.kernels.cut`), so that coarse
    chunks come first.

    Args:
        chunks: (N,) which are looked into, any number of times each.
        pixel_scales: (N,) of the nodes whose children are in them. NaN counts as the largest, as in the traversal.
    """
    if not len(chunks):
        return []
    greatest = np.full(int(chunks.max()) + 1, -1.0)
    np.maximum.at(greatest, chunks, np.where(np.isnan(pixel_scales), np.inf, pixel_scales))
    touched = np.flatnonzero(greatest >= 0)
    return touched[np.argsort(-greatest[touched], kind="stable")].tolist()


class ChunkCache:
    """Holds chunks, and gives up the least recently used ones when they are too many.

    A chunk is used when it arrives, and all the time that it is wanted; of those in use the more important counts as
    the more recently used. What is wanted beyond the capacity is not worth fetching: it would push out something more
    important, or be pushed out by it. Spark's pager does all this too.

    Args:
        chunks: of all trees. Their roots are always wanted, and more than all others.
        capacity: how many fit; None for all.

    Attributes:
        wanted: what is wanted, each chunk once, the most important first.
        admitted: as much of it as fits. Of this nothing is ever given up.

    Raises:
        ValueError: the capacity is less than the number of trees.
    """

    def __init__(self, chunks: Chunks, capacity: int | None = None) -> None:
        if capacity is not None and capacity < len(chunks.roots):
            raise ValueError(
                f"a cache of {capacity} chunks cannot hold the roots of {len(chunks.roots)} trees; make it larger"
            )
        self._chunks, self._capacity = chunks, capacity
        self._roots = frozenset(chunks.roots)
        # From the first to be given up to the last: what is not wanted by last use, then what is, against its order.
        self._resident: OrderedDict[int, None] = OrderedDict()
        self.wanted: list[int] = []
        self.admitted: list[int] = []
        self._is_admitted: frozenset[int] = frozenset()

    def __len__(self) -> int:
        return len(self._resident)

    def __contains__(self, chunk: int) -> bool:
        return chunk in self._resident

    def resident(self) -> NDArray[np.bool_]:
        """(chunks,) which are here, as `lod.traversal.Traversal.cut` takes it."""
        present = np.zeros(len(self._chunks), np.bool_)
        present[list(self._resident)] = True
        return present

    def missing(self) -> list[int]:
        """What is to be here and is not, the most important first."""
        return [chunk for chunk in self.admitted if chunk not in self._resident]

    def want(self, wanted: Iterable[int]) -> None:
        """Replaces what is wanted.

        Args:
            wanted: chunks, the most important first. The roots of all trees come before them, in this order too,
                whether named or not.

        Raises:
            ValueError: there is no such chunk.
        """
        named = [int(chunk) for chunk in wanted]
        if named and not 0 <= min(named) <= max(named) < len(self._chunks):
            raise ValueError(f"chunks {min(named)} to {max(named)} are wanted, but there are {len(self._chunks)}")
        self._arrange()  # what was wanted until now was used until now
        roots = [chunk for chunk in named if chunk in self._roots]
        self.wanted = list(dict.fromkeys([*roots, *self._chunks.roots, *named]))
        self.admitted = self.wanted[: self._capacity]
        self._is_admitted = frozenset(self.admitted)
        self._arrange()

    def arrive(self, chunk: int) -> int | None:
        """A chunk has been fetched and takes its place.

        Returns:
            the chunk that was given up for it: the least recently used one of those that are not wanted, or else the
            least important. It may be the newcomer itself, when it was wanted once and is not any more. None if
            there was room.
        """
        self._resident[chunk] = None
        # The admitted fit, so when one of them makes it too many, there is a chunk here that is none of them, and that
        # comes before them all. Any other newcomer has to get to its place for this.
        if chunk not in self._is_admitted:
            self._arrange()
        if self._capacity is None or len(self._resident) <= self._capacity:
            return None
        evicted, _ = self._resident.popitem(last=False)
        return evicted

    def copy(self) -> ChunkCache:
        """A cache that goes its own way from here."""
        twin = copy.copy(self)  # the lists are replaced, never changed
        twin._resident = self._resident.copy()
        return twin

    def _arrange(self) -> None:
        """Puts what is resident into the order in which it is to be given up."""
        for chunk in reversed(self.wanted):
            if chunk in self._resident:
                self._resident.move_to_end(chunk)
