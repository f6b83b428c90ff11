"""Chunks of trees: their numbers, and a cache with least-recently-used eviction."""

from __future__ import annotations

import copy
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..lod.settings import FETCHERS

#: How many bytes Spark's pager asks for at first, then if they do not hold the whole header of a file.
HEADER_REQUESTS = (64 << 10, 256 << 10, 1 << 20)


def header_answers(header_bytes: int, file_bytes: int) -> tuple[int, ...]:
    """Return the sizes of the answers that Spark's pager waits for before it can ask for a chunk of a file.

    It does not know how long the header is, so it asks for the beginning of the file, and for more of it as long as the
    header is not whole. What it gets of the first chunk along with it is thrown away.

    Args:
        header_bytes: of the header; 0 where the format has none that a viewer would need.
    """
    answers: list[int] = []
    for request in HEADER_REQUESTS:
        if (answers[-1] if answers else 0) < header_bytes:
            answers.append(min(request, file_bytes))
    return tuple(answers)


class Chunks:
    """The chunks of all trees, numbered consecutively, tree by tree.

    The numbers are those of `lod.traversal.Forest.chunk_base`.

    Args:
        sizes: for each tree the sizes of its chunks in the file, bytes.
        headers: for each tree the sizes of the answers that a viewer waits for, one after the other, before it can ask
            for a chunk, see `header_answers`; none unless given.
        rooted: whether trees are drawn from their first chunks on, which hold their roots; chunk files of Streamed SOG
            are drawn each for itself.
        fetchers: chunks that a viewer fetches at a time, unless it is told otherwise.
        connections: requests that are under way at a time; None for any number.

    Attributes:
        sizes: of each chunk, bytes.
        requests: for each chunk, bytes of the answers that it takes: to a first request, and to those that follow it
            together.
        firsts: the first chunk of each tree.
        roots: the chunks that are always wanted: the first of each tree if `rooted`.

    Raises:
        ValueError: a tree has no chunks, or a size is negative; or there are not as many headers as trees.
    """

    def __init__(
        self,
        sizes: Sequence[ArrayLike],
        headers: Sequence[Sequence[int]] | None = None,
        *,
        rooted: bool = True,
        fetchers: int = FETCHERS,
        connections: int | None = None,
    ) -> None:
        self.fetchers = fetchers
        self.connections = connections
        self.sizes: list[int] = []
        self.firsts: list[int] = []
        self.headers = [tuple(each) for each in headers or [()] * len(sizes)]
        if len(self.headers) != len(sizes):
            raise ValueError(f"there are {len(self.headers)} headers of {len(sizes)} trees")
        for tree, of_tree in enumerate(sizes):
            column = np.asarray(of_tree, np.int64)
            if column.ndim != 1 or not len(column) or column.min() < 0:
                raise ValueError(f"the chunks of tree {tree} must be a list of sizes, each 0 or more")
            self.firsts.append(len(self.sizes))
            self.sizes += column.tolist()
        self.roots = self.firsts if rooted else []
        self.requests: list[tuple[int, ...]] = [(size,) for size in self.sizes]

    @classmethod
    def of_requests(
        cls,
        requests: Sequence[Sequence[tuple[int, ...]]],
        headers: Sequence[Sequence[int]],
        *,
        fetchers: int,
        connections: int | None,
    ) -> Chunks:
        """Return chunk files, for each scene, that take several requests each, and are drawn each for itself."""
        sizes = [[sum(parts) for parts in of_scene] for of_scene in requests]
        chunks = cls(sizes, headers, rooted=False, fetchers=fetchers, connections=connections)
        chunks.requests = [parts or (0,) for of_scene in requests for parts in of_scene]
        return chunks

    def __len__(self) -> int:
        return len(self.sizes)

    def tree_of(self, chunk: int) -> int:
        """Return the tree of a chunk."""
        return bisect_right(self.firsts, chunk) - 1

    def shows(self, resident: NDArray[np.bool_]) -> bool:
        """Return True if anything is drawn with (chunks,) bool resident chunks."""
        return bool((resident[self.roots] if self.roots else resident).any())

    def bytes_of(self, chunks: Iterable[int]) -> int:
        """Return the total size of some chunks."""
        return sum(self.sizes[chunk] for chunk in chunks)


class ChunkCache:
    """Holds chunks, and evicts the least recently used ones when it is full.

    A chunk is used when it arrives and as long as it is wanted; among wanted chunks the more important one counts as
    more recently used. Wanted chunks beyond the capacity are not fetched, since they would evict more important ones or
    be evicted by them. Spark's pager works the same way.

    Args:
        chunks: the chunks of all trees. Chunks with roots are always wanted, and come first.

    Attributes:
        requested: the wanted chunks, each once, the most important first.
        admitted: the first of them, as many as fit; they are never evicted.

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
        # In order of eviction: unwanted chunks by last use, then wanted ones, the least important first.
        self._resident: OrderedDict[int, None] = OrderedDict()
        self.requested: list[int] = []
        self.admitted: list[int] = []
        self._is_admitted: frozenset[int] = frozenset()

    def __len__(self) -> int:
        return len(self._resident)

    def __contains__(self, chunk: int) -> bool:
        return chunk in self._resident

    def resident(self) -> NDArray[np.bool_]:
        """Return the resident chunks, (chunks,) bool, for `lod.traversal.Traversal.cut`."""
        present = np.zeros(len(self._chunks), np.bool_)
        present[list(self._resident)] = True
        return present

    def missing(self) -> list[int]:
        """Return the admitted chunks that are not resident, the most important first."""
        return [chunk for chunk in self.admitted if chunk not in self._resident]

    def want(self, requested: Iterable[int]) -> None:
        """Replace the list of wanted chunks.

        Args:
            requested: chunks, the most important first. The roots of all trees come before them, in this order,
                too, whether listed or not.

        Raises:
            ValueError: there is no such chunk.
        """
        named = [int(chunk) for chunk in requested]
        if named and not 0 <= min(named) <= max(named) < len(self._chunks):
            raise ValueError(f"chunks {min(named)} to {max(named)} are wanted, but there are {len(self._chunks)}")
        self._arrange()  # chunks wanted until now count as used until now
        roots = [chunk for chunk in named if chunk in self._roots]
        self.requested = list(dict.fromkeys([*roots, *self._chunks.roots, *named]))
        self.admitted = self.requested[: self._capacity]
        self._is_admitted = frozenset(self.admitted)
        self._arrange()

    def arrive(self, chunk: int) -> int | None:
        """Add a chunk that has been fetched.

        Returns:
            the chunk that was evicted: the least recently used of the unwanted chunks, or else the least important. It
            may be the new chunk itself, if it is no longer wanted. None if nothing was evicted.
        """
        self._resident[chunk] = None
        # All admitted chunks fit, so if an admitted one exceeds the capacity, the first in the order of eviction is not
        # admitted. Any other new chunk must first be moved to its place in that order.
        if chunk not in self._is_admitted:
            self._arrange()
        if self._capacity is None or len(self._resident) <= self._capacity:
            return None
        evicted, _ = self._resident.popitem(last=False)
        return evicted

    def copy(self) -> ChunkCache:
        """Return an independent copy of the cache."""
        twin = copy.copy(self)  # the lists are replaced, never changed
        twin._resident = self._resident.copy()
        return twin

    def _arrange(self) -> None:
        """Put the resident chunks in order of eviction."""
        for chunk in reversed(self.requested):
            if chunk in self._resident:
                self._resident.move_to_end(chunk)
