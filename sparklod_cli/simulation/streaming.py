"""How chunks get to a viewer over a network, in time: an exact simulation from event to event."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from heapq import heappop, heappush

from ..support.defaults import FETCHERS
from .chunk_cache import ChunkCache, Chunks


@dataclass(frozen=True)
class Network:
    """What stands between a viewer and the files. The default brings everything at once.

    Attributes:
        bandwidth: bytes/s, shared equally by all transfers under way.
        latency: seconds from asking for a chunk to its first byte, during which no bandwidth is used.
        fetchers: how many chunks may be under way at a time; Spark's `numFetchers` is 3.

    Raises:
        ValueError: one of them is out of its range.
    """

    bandwidth: float = math.inf
    latency: float = 0.0
    fetchers: int = FETCHERS

    def __post_init__(self) -> None:
        if not self.bandwidth > 0:
            raise ValueError(f"a bandwidth of {self.bandwidth:g} bytes/s brings nothing; make it more than 0")
        if not 0 <= self.latency < math.inf:
            raise ValueError(f"a latency of {self.latency:g} s is not possible; make it 0 or more")
        if self.fetchers < 1:
            raise ValueError(f"{self.fetchers} fetchers bring nothing; make it 1 or more")

    @property
    def instant(self) -> bool:
        """Whether everything comes at once."""
        return self.bandwidth == math.inf and self.latency == 0


@dataclass(frozen=True)
class StreamingSettings:
    """How chunks get to a viewer and stay with it.

    Attributes:
        network: that brings them; by default everything comes at once.
        chunk_cache: the most chunks of 65,536 nodes that the viewer holds; None for all.
    """

    network: Network = field(default_factory=Network)
    chunk_cache: int | None = None


class Stream:
    """Fetches the chunks that a viewer wants and keeps them in a cache.

    For each frame: `advance` to its time, `want` what it looks into, `take_arrivals` to see what is new; then
    `cache.resident()` is what can be drawn.

    A fetcher that is free takes the most important of the admitted chunks that is neither here nor under way. Nothing
    under way is cancelled, as in Spark; a chunk that is no longer wanted when it arrives goes into the cache if there
    is room, or in place of one that has not been used for longer. Decoding takes no time here, and nothing fails.

    State changes at events only, so the same happens whether time advances in one step or in many.

    Args:
        chunks: of all trees.
        network: what brings them; everything comes at once unless given.
        capacity: how many chunks the cache holds; None for all.
        start: seconds, the time it begins at.

    Attributes:
        cache: the resident chunks.
        now: seconds.

    Raises:
        ValueError: the capacity is less than the number of trees.
    """

    def __init__(
        self, chunks: Chunks, network: Network | None = None, *, capacity: int | None = None, start: float = 0.0
    ) -> None:
        self._chunks = chunks
        self._network = network or Network()
        self.cache = ChunkCache(chunks, capacity)
        self.now = start
        self._next = 0  # all admitted chunks before this one are here or under way
        self._under_way: set[int] = set()
        # (When its first byte comes, chunk); in order, since the latency is the same for all.
        self._asked: deque[tuple[float, int]] = deque()
        # All transfers under way get the same. `_served` is how many bytes each would have had at the time `_since` if
        # it had begun with the first: one ends when that has grown by its size, whatever begins and ends until then.
        self._transfers: list[tuple[float, int, int]] = []  # heap of (what `_served` is at its end, number, chunk)
        self._served = 0.0
        self._since = start
        self._begun = 0
        self._arrived: list[int] = []

    def advance(self, to_time: float) -> None:
        """Lets everything happen until a time, in seconds, itself included.

        Raises:
            ValueError: the time is in the past, or not finite.
        """
        if not self.now <= to_time < math.inf:
            raise ValueError(
                f"time went from {self.now:g} s to {to_time:g} s; it can only go forward, and not for ever"
            )
        while self._happens(to_time):
            pass
        self.now = to_time

    def want(self, wanted: Iterable[int]) -> None:
        """Replaces what is wanted from now on, the most important first, as `ChunkCache.want` does.

        Raises:
            ValueError: there is no such chunk.
        """
        self.cache.want(wanted)
        self._next = 0
        self._ask(self.now)
        self.advance(self.now)  # where the network brings everything at once, it is here now

    def take_arrivals(self) -> list[int]:
        """The chunks that have arrived since the last call, in order; also those that the cache has given up again."""
        arrived, self._arrived = self._arrived, []
        return arrived

    def complete_in(self, wanted: Iterable[int]) -> float | None:
        """Seconds until all these chunks are resident if nothing else is wanted from now on.

        Returns:
            0 if it is here already; None if it never will be, because it does not fit into the cache.
        """
        future = self._copy()
        future.want(wanted)
        if len(future.cache.admitted) < len(future.cache.wanted):
            return None
        missing = set(future.cache.missing())
        if not missing:
            return 0.0
        future.take_arrivals()
        while missing and future._happens(math.inf):
            missing.difference_update(future.take_arrivals())
        return future._since - self.now

    def _copy(self) -> Stream:
        twin = copy.copy(self)
        twin.cache = self.cache.copy()
        twin._under_way, twin._asked = self._under_way.copy(), self._asked.copy()
        twin._transfers, twin._arrived = self._transfers.copy(), self._arrived.copy()
        return twin

    def _ask(self, time: float) -> None:
        """Gives work to the fetchers that are free."""
        admitted = self.cache.admitted
        while len(self._under_way) < self._network.fetchers and self._next < len(admitted):
            chunk = admitted[self._next]
            self._next += 1
            if chunk not in self.cache and chunk not in self._under_way:
                self._under_way.add(chunk)
                self._asked.append((time + self._network.latency, chunk))

    def _happens(self, until: float) -> bool:
        """Lets the next event happen, if there is one until a time: a transfer ends, or one begins."""
        if not self._under_way:
            return False
        begin = self._asked[0][0] if self._asked else math.inf
        end = math.inf
        if self._transfers:
            end = self._since + (self._transfers[0][0] - self._served) * len(self._transfers) / self._network.bandwidth
        if min(begin, end) > until:
            return False
        if end <= begin:
            self._end(end)
        else:
            self._begin(begin)
        return True

    def _begin(self, time: float) -> None:
        """The first byte of the chunk that was asked for first arrives."""
        if self._transfers:
            served = self._served + (time - self._since) * self._network.bandwidth / len(self._transfers)
            self._served = min(served, self._transfers[0][0])  # rounding must not take it past an end
        self._since = time
        _, chunk = self._asked.popleft()
        self._begun += 1
        heappush(self._transfers, (self._served + self._chunks.sizes[chunk], self._begun, chunk))

    def _end(self, time: float) -> None:
        """The last byte of the transfer that has least to go arrives, and its fetcher takes on another chunk."""
        self._served, _, chunk = heappop(self._transfers)
        if not self._transfers:
            self._served = 0.0  # small numbers have more digits to spare
        self._since = time
        self._under_way.remove(chunk)
        self._arrived.append(chunk)
        self.cache.arrive(chunk)
        self._ask(time)
