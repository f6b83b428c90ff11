"""Streaming of chunks to a viewer: its cache, and an exact discrete-event simulation of the network."""

from __future__ import annotations

import copy
import itertools
import math
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from ..system.errors import UnfitError
from .viewer_settings import FETCHERS, Network


class Chunks:
    """The chunks of all scenes, numbered consecutively, scene by scene, as in `loaded_scene.Forest.chunk_base`.

    Args:
        requests: for each scene and chunk, bytes of the answer to its first request, and of the answers to the others,
            which are sent together.
        headers: for each scene, bytes of the answers that a viewer receives, one after the other, before it can request
            a chunk.
        rooted: the first chunk of each scene holds its root, and is always wanted; False for Streamed SOG, each of
            whose chunk files is drawn by itself.
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
        self.firsts = [0, *itertools.accumulate(map(len, requests))][:-1]
        self.roots = self.firsts if rooted else []

    def shows(self, resident: NDArray[np.bool_]) -> bool:
        """Return whether a viewer draws anything with (chunks,) bool resident chunks."""
        return bool((resident[self.roots] if self.roots else resident).any())


class ChunkCache:
    """Holds chunks, and evicts the least recently used ones when it is full.

    A chunk is used when it arrives and as long as it is wanted; among wanted chunks a more important one counts as
    more recently used. Wanted chunks beyond the capacity are not fetched, since they would evict more important ones or
    be evicted by them. Spark's pager works the same way. Chunks with roots are always wanted, and come first.
    `UnfitError` if the capacity is less than the number of trees.

    Attributes:
        requested: the wanted chunks, each once, the most important first.
        admitted: as many of the first requested chunks as fit; they are never evicted.
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

    def want(self, requested: Sequence[int]) -> None:
        """Replace the list of wanted chunks, the most important first.

        Chunks with roots come before them: first the listed ones, in this order, then all others.
        """
        self._arrange()  # chunks wanted until now count as used until now
        roots = [chunk for chunk in requested if chunk in self._roots]
        self.requested = list(dict.fromkeys([*roots, *self._chunks.roots, *requested]))
        self.admitted = self.requested[: self._capacity]
        self._is_admitted = frozenset(self.admitted)
        self._arrange()

    def arrive(self, chunk: int) -> int | None:
        """Add a fetched chunk, and return the evicted one, or None.

        The least recently used of the unwanted chunks is evicted, or else the least important wanted one. That may be
        the new chunk itself, if it is no longer wanted.
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


#: A request for a part of `Chunks.requests` of a chunk: (chunk, part); or for the next answer with the header of a
#: tree: (-1 - tree, 0).
Request = tuple[int, int]


class ChunkStream:
    """Fetches the chunks that a viewer wants, over a simulated network, into a cache.

    For each frame: `advance` to its time, `want` the chunks that its cut reads, and `take_arrivals` for the new ones;
    a viewer can then draw with `cache.resident()`.

    A free fetcher requests the most important admitted chunk that is neither resident nor under way. Requests are not
    cancelled, as in Spark; a chunk that is no longer wanted when it arrives goes into the cache if there is room, or in
    place of one that has not been used for longer. Decoding takes no time, and no request fails.

    A chunk arrives with the last of its answers (`Chunks.requests`): first one to a single request, then those to the
    others, which are sent together. Requests wait for a free connection, in order.

    If a viewer needs headers first (`Chunks.headers`), it requests them at the start, all at once and without fetchers;
    a fetcher with a chunk of such a tree waits for its header, as in Spark.

    The state changes at events only, so the result does not depend on the steps in which time advances.

    Attributes:
        now: the current time, seconds.
        received: bytes received since the start, headers included.
    """

    def __init__(
        self, chunks: Chunks, network: Network | None = None, *, capacity: int | None = None, start: float = 0.0
    ) -> None:
        self._chunks = chunks
        self._network = network or Network()
        self._fetchers = self._network.fetchers or chunks.fetchers
        self.cache = ChunkCache(chunks, capacity)
        self.now = start
        self._next = 0  # all admitted chunks before this one are resident or under way
        self._missing: dict[int, int] = {}  # of chunks under way, the answers that have not arrived
        # (Time of its first byte, request), in order, since all have the same latency.
        self._requested: deque[tuple[float, Request]] = deque()
        self._connections = chunks.connections or math.inf
        self._queue: deque[Request] = deque()  # requests that wait for a connection
        # For each tree whose header is under way, the answers that are still to come, and the chunks that wait for it.
        self._headers = {tree: answers for tree, answers in enumerate(chunks.headers) if answers}
        self._waiting: dict[int, tuple[int, ...]] = dict.fromkeys(self._headers, ())
        self.received = self._taken = 0
        # Concurrent transfers share the bandwidth equally. `_served` is the number of bytes that a transfer which began
        # with the first would have received at time `_since`; a transfer ends when that has grown by its size.
        self._transfers: list[tuple[float, int, Request]] = []  # heap of (`_served` at its end, number, request)
        self._served = 0.0
        self._since = start
        self._begun = 0
        self._arrived: list[int] = []
        for tree in self._headers:
            self._ask(start, (-1 - tree, 0))

    def advance(self, to_time: float) -> None:
        """Process all events up to a time in seconds; raise `ValueError` if it is in the past, or not finite."""
        if not self.now <= to_time < math.inf:
            raise ValueError(f"time went from {self.now:g} s to {to_time:g} s; it must increase and be finite")
        while self._step(to_time):
            pass
        self.now = to_time

    def want(self, requested: Sequence[int]) -> None:
        """Replace the list of wanted chunks, see `ChunkCache.want`, and request them."""
        self.cache.want(requested)
        self._next = 0
        self._request(self.now)
        self.advance(self.now)  # with an instant network everything arrives now

    def take_arrivals(self) -> list[int]:
        """Return the chunks that arrived since the last call, in order, evicted ones included."""
        arrived, self._arrived = self._arrived, []
        return arrived

    def take_bytes(self) -> int:
        """Return the bytes received since the last call, headers included."""
        taken, self._taken = self.received - self._taken, self.received
        return taken

    def step(self) -> bool:
        """Advance to the next event, the start or end of a transfer; return False if nothing is under way."""
        going = self._step(math.inf)
        self.now = self._since if going else self.now
        return going

    def complete_in(self, requested: Sequence[int]) -> float | None:
        """Return the seconds until all these chunks are resident, if no others are; None if the cache is too small."""
        future = self._copy()
        future.want(requested)
        if len(future.cache.admitted) < len(future.cache.requested):
            return None
        missing = set(future.cache.missing())
        if not missing:
            return 0.0
        future.take_arrivals()
        while missing and future._step(math.inf):
            missing.difference_update(future.take_arrivals())
        return future._since - self.now

    def _copy(self) -> ChunkStream:
        twin = copy.copy(self)
        twin.cache = self.cache.copy()
        twin._missing, twin._requested, twin._queue = self._missing.copy(), self._requested.copy(), self._queue.copy()
        twin._transfers, twin._arrived = self._transfers.copy(), self._arrived.copy()
        twin._headers, twin._waiting = self._headers.copy(), self._waiting.copy()
        return twin

    def _request(self, time: float) -> None:
        """Start requests on the free fetchers."""
        admitted = self.cache.admitted
        while len(self._missing) < self._fetchers and self._next < len(admitted):
            chunk = admitted[self._next]
            self._next += 1
            if chunk not in self.cache and chunk not in self._missing:
                self._missing[chunk] = len(self._chunks.requests[chunk])
                tree = bisect_right(self._chunks.firsts, chunk) - 1
                if tree in self._waiting:
                    self._waiting[tree] += (chunk,)
                else:
                    self._ask(time, (chunk, 0))

    def _ask(self, time: float, request: Request) -> None:
        """Send a request, or queue it until a connection is free."""
        if len(self._requested) + len(self._transfers) < self._connections:
            self._requested.append((time + self._network.latency, request))
        else:
            self._queue.append(request)

    def _size(self, request: Request) -> int:
        chunk, part = request
        return self._headers[-1 - chunk][0] if chunk < 0 else self._chunks.requests[chunk][part]

    def _step(self, until: float) -> bool:
        """Process the next event, the start or end of a transfer, if it is due by a time; return whether it was."""
        if not self._requested and not self._transfers:
            return False
        begin = self._requested[0][0] if self._requested else math.inf
        end = math.inf
        if self._transfers:
            end = self._since + (self._transfers[0][0] - self._served) * len(self._transfers) / self._network.bandwidth
        if min(begin, end) > until:
            return False
        if begin < end:  # the first byte of the oldest request
            if self._transfers:
                served = self._served + (begin - self._since) * self._network.bandwidth / len(self._transfers)
                self._served = min(served, self._transfers[0][0])  # rounding must not exceed the next end
            self._since = begin
            _, request = self._requested.popleft()
            self._begun += 1
            heappush(self._transfers, (self._served + self._size(request), self._begun, request))
            return True
        self._served, _, request = heappop(self._transfers)  # the last byte of a transfer
        if not self._transfers:
            self._served = 0.0  # keeps the numbers small, for precision
        self._since = end
        if self._queue:
            self._ask(end, self._queue.popleft())
        self.received += self._size(request)
        chunk, part = request
        if chunk < 0:
            self._end_header(-1 - chunk, end)
            return True
        self._missing[chunk] -= 1
        if part == 0:
            for other in range(1, len(self._chunks.requests[chunk])):
                self._ask(end, (chunk, other))
        if not self._missing[chunk]:
            del self._missing[chunk]
            self._arrived.append(chunk)
            self.cache.arrive(chunk)
            self._request(end)
        return True

    def _end_header(self, tree: int, time: float) -> None:
        """Process an answer with a part of a header: request the next part, or the waiting chunks."""
        _, *rest = self._headers[tree]
        if rest:
            self._headers[tree] = tuple(rest)
            self._ask(time, (-1 - tree, 0))
            return
        del self._headers[tree]
        for chunk in self._waiting.pop(tree):
            self._ask(time, (chunk, 0))
