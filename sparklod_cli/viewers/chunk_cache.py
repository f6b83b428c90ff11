"""Chunks of the scenes in a viewer, and the cache that it keeps them in."""

from __future__ import annotations

import copy
import itertools
from collections import OrderedDict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..system.errors import UnfitError
from .viewer_settings import FETCHERS


class Chunks:
    """The chunks of all scenes, numbered consecutively, scene by scene, as in `cut.Forest.chunk_base`.

    Args:
        requests: for each scene and chunk, bytes of the answer to its first request, and of the answers to the others,
            which are asked for together.
        headers: for each scene the sizes of the answers that a viewer waits for, one after the other, before it can ask
            for a chunk.
        rooted: the first chunk of each scene holds its root, and is always wanted; False for Streamed SOG, whose chunk
            files are drawn each for itself.
        connections: largest number of concurrent requests; None for any number.

    Attributes:
        sizes: bytes of each chunk.
        firsts: the first chunk of each scene.
        roots: the chunks that are always wanted.
    """

    def __init__(
        self,
        requests: Sequence[Sequence[tuple[int, ...]]],
        headers: Sequence[Sequence[int]] | None = None,
        *,
        rooted: bool = True,
        fetchers: int = FETCHERS,
        connections: int | None = None,
    ) -> None:
        self.fetchers = fetchers
        self.connections = connections
        self.requests = [parts or (0,) for of_scene in requests for parts in of_scene]
        self.sizes = list(map(sum, self.requests))
        self.headers = [tuple(each) for each in headers or [()] * len(requests)]
        if len(self.headers) != len(requests):
            raise ValueError(f"there are {len(self.headers)} headers of {len(requests)} trees")
        for tree, of_tree in enumerate(requests):
            if not len(of_tree) or min(map(min, filter(None, of_tree)), default=0) < 0:
                raise ValueError(f"the chunks of tree {tree} must be a list of sizes, each 0 or more")
        self.firsts = [0, *itertools.accumulate(map(len, requests))][:-1]
        self.roots = self.firsts if rooted else []

    def shows(self, resident: NDArray[np.bool_]) -> bool:
        """Return True if anything is drawn with (chunks,) bool resident chunks."""
        return bool((resident[self.roots] if self.roots else resident).any())


class ChunkCache:
    """Holds chunks, and evicts the least recently used ones when it is full.

    A chunk is used when it arrives and as long as it is wanted; among wanted chunks the more important one counts as
    more recently used. Wanted chunks beyond the capacity are not fetched, since they would evict more important ones or
    be evicted by them. Spark's pager works the same way. Chunks with roots are always wanted, and come first.
    `UnfitError` if the capacity is less than the number of trees.

    Attributes:
        requested: the wanted chunks, each once, the most important first.
        admitted: the first of them, as many as fit; they are never evicted.
    """

    def __init__(self, chunks: Chunks, capacity: int | None = None) -> None:
        if capacity is not None and capacity < len(chunks.roots):
            raise UnfitError(
                f"a cache of {capacity} chunks cannot hold the roots of {len(chunks.roots)} trees; make it larger"
            )
        self._chunks, self._capacity = chunks, capacity
        self._roots = frozenset(chunks.roots)
        # In order of eviction: unwanted chunks by last use, then wanted ones, the least important first.
        self._resident: OrderedDict[int, None] = OrderedDict()
        self.requested: list[int] = []
        self.admitted: list[int] = []
        self._is_admitted: frozenset[int] = frozenset()

    def __contains__(self, chunk: int) -> bool:
        return chunk in self._resident

    def resident(self) -> NDArray[np.bool_]:
        """Return the resident chunks, (chunks,) bool, for `Viewer.cut`."""
        present = np.zeros(len(self._chunks.sizes), np.bool_)
        present[list(self._resident)] = True
        return present

    def missing(self) -> list[int]:
        """Return the admitted chunks that are not resident, the most important first."""
        return [chunk for chunk in self.admitted if chunk not in self._resident]

    def want(self, requested: Iterable[int]) -> None:
        """Replace the list of wanted chunks, the most important first; `ValueError` if there is no such chunk.

        The roots of all trees come before them, in this order, too, whether listed or not.
        """
        named = [int(chunk) for chunk in requested]
        if named and not 0 <= min(named) <= max(named) < len(self._chunks.sizes):
            raise ValueError(f"chunks {min(named)} to {max(named)} are wanted, but there are {len(self._chunks.sizes)}")
        self._arrange()  # chunks wanted until now count as used until now
        roots = [chunk for chunk in named if chunk in self._roots]
        self.requested = list(dict.fromkeys([*roots, *self._chunks.roots, *named]))
        self.admitted = self.requested[: self._capacity]
        self._is_admitted = frozenset(self.admitted)
        self._arrange()

    def arrive(self, chunk: int) -> int | None:
        """Add a chunk that has been fetched, and return the one that was evicted; None if none was.

        That is the least recently used of the unwanted chunks, or else the least important. It may be the new chunk
        itself, if it is no longer wanted.
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
        twin = copy.copy(self)  # the lists are replaced, never changed
        twin._resident = self._resident.copy()
        return twin

    def _arrange(self) -> None:
        """Put the resident chunks in order of eviction."""
        for chunk in reversed(self.requested):
            if chunk in self._resident:
                self._resident.move_to_end(chunk)
