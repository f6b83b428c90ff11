"""Streaming in exact fractions: a cache that is searched linearly, and a network that shares its rate among fetches."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from sparklod_cli.viewers.streaming import Chunks
from sparklod_cli.viewers.viewer_settings import Network

#: Seconds; of two events nearer than this, rounding decides which comes first.
TIE = Fraction(1, 10**9)


class NaiveCache:
    """For each resident chunk, when it was last used and at which place of the wanted list; the smallest is evicted."""

    def __init__(self, capacity: int | None) -> None:
        self.capacity = math.inf if capacity is None else capacity
        self.requested: list[int] = []
        self.used: dict[int, tuple[int, float]] = {}
        self.clock = 0

    def want(self, requested: list[int]) -> None:
        self.requested = requested
        self.use()

    def arrive(self, chunk: int) -> int | None:
        self.used[chunk] = (self.clock + 1, -math.inf)
        self.use()
        if len(self.used) <= self.capacity:
            return None
        evicted = min(self.used, key=lambda each: self.used[each])
        del self.used[evicted]
        return evicted

    def use(self) -> None:
        self.clock += 1
        for place, chunk in enumerate(self.requested):
            if chunk in self.used:
                self.used[chunk] = (self.clock, -place)


def sized(sizes: Sequence[Sequence[int]], headers: Sequence[Sequence[int]] | None = None) -> Chunks:
    """Chunks of trees, each of one request."""
    return Chunks([[(size,) for size in of_tree] for of_tree in sizes], headers)


def roots_first(chunks: Chunks, requested: list[int]) -> list[int]:
    """Returns a list of wanted chunks without repetitions, roots first."""
    result: list[int] = []
    for chunk in [each for each in requested if each in chunks.roots] + chunks.roots + requested:
        if chunk not in result:
            result.append(chunk)
    return result


@dataclass
class Fetch:
    """A fetch under way; `latency` in seconds and `left` in bytes are what remains."""

    asked: Fraction
    chunk: int
    part: int
    latency: Fraction
    left: Fraction


@dataclass
class Twin:
    """Does what `Stream` does, in fractions and one event at a time.

    Attributes:
        opening: for each tree, the beginnings of its file that are still to come; their fetches have negative numbers.
        waiting: chunks that wait for them.
        queued: chunks and numbers of their answers that wait for a connection.
        missing: for each chunk under way, numbers of the answers that have not come.
        received: bytes of all that has come.
    """

    chunks: Chunks
    network: Network
    cache: NaiveCache
    now: Fraction = Fraction(0)
    fetches: list[Fetch] = field(default_factory=list)
    arrivals: list[tuple[Fraction, int]] = field(default_factory=list)
    tied: bool = False  # rounding may have decided otherwise
    opening: list[list[int]] = field(init=False)
    waiting: list[int] = field(default_factory=list)
    queued: list[tuple[int, int]] = field(default_factory=list)
    missing: dict[int, set[int]] = field(default_factory=dict)
    received: int = 0

    def __post_init__(self) -> None:
        self.opening = [list(each) for each in self.chunks.headers]
        for tree, answers in enumerate(self.opening):
            if answers:
                self.fetch(-1 - tree)

    def size(self, number: int, part: int = 0) -> int:
        return self.chunks.requests[number][part] if number >= 0 else self.opening[-1 - number][0]

    def tree(self, chunk: int) -> int:
        return sum(first <= chunk for first in self.chunks.firsts) - 1

    def fetch(self, number: int, part: int = 0) -> None:
        self.queued.append((number, part))
        self.connect()

    def connect(self) -> None:
        while self.queued and len(self.fetches) < (self.chunks.connections or math.inf):
            number, part = self.queued.pop(0)
            size = Fraction(self.size(number, part))
            self.fetches.append(Fetch(self.now, number, part, Fraction(self.network.latency), size))

    def advance(self, to_time: Fraction) -> None:
        while True:
            active = [fetch for fetch in self.fetches if fetch.latency == 0]
            rate = Fraction(self.network.bandwidth) / max(1, len(active))
            due = [fetch.left / rate for fetch in active]
            due += [fetch.latency for fetch in self.fetches if fetch.latency > 0]
            ends = sorted((fetch.left / rate, fetch.asked, self.size(fetch.chunk, fetch.part)) for fetch in active)
            self.tied |= any(b[0] - a[0] <= TIE and a != b for a, b in itertools.pairwise(ends))
            self.tied |= any(abs(end[0] - (to_time - self.now)) <= TIE for end in ends)
            step = min([to_time - self.now, *due])
            self.now += step
            for fetch in self.fetches:
                if fetch in active:
                    fetch.left -= step * rate
                else:
                    fetch.latency -= step
            done = [fetch for fetch in active if fetch.left == 0]
            if not done and self.now == to_time:
                return
            for fetch in done[:1]:
                self.fetches.remove(fetch)
                self.connect()
                self.received += self.size(fetch.chunk, fetch.part)
                if fetch.chunk < 0:
                    self.opened(-1 - fetch.chunk)
                    continue
                self.missing[fetch.chunk].remove(fetch.part)
                if fetch.part == 0:
                    for part in sorted(self.missing[fetch.chunk]):
                        self.fetch(fetch.chunk, part)
                if self.missing[fetch.chunk]:
                    continue
                del self.missing[fetch.chunk]
                self.arrivals.append((self.now, fetch.chunk))
                self.cache.arrive(fetch.chunk)
                self.ask()

    def want(self, requested: list[int]) -> None:
        self.cache.want(roots_first(self.chunks, requested))
        self.ask()

    def opened(self, tree: int) -> None:
        """The beginning of a file has come: a longer one is fetched, or the chunks that wait for it."""
        self.opening[tree].pop(0)
        if self.opening[tree]:
            self.fetch(-1 - tree)
            return
        for chunk in [each for each in self.waiting if self.tree(each) == tree]:
            self.waiting.remove(chunk)
            self.fetch(chunk)

    def ask(self) -> None:
        for place, chunk in enumerate(self.cache.requested):
            under_way = self.missing
            is_free = place < self.cache.capacity and len(under_way) < self.network.fetchers
            if is_free and chunk not in self.cache.used and chunk not in under_way:
                self.missing[chunk] = set(range(len(self.chunks.requests[chunk])))
                if self.opening[self.tree(chunk)]:
                    self.waiting.append(chunk)
                else:
                    self.fetch(chunk)
