"""Streaming of chunks: the cache, laws and closed forms of the network, and exact twins."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sparklod_cli.viewers.loaded_scene import header_answers
from sparklod_cli.viewers.streaming import ChunkCache, Chunks, ChunkStream
from sparklod_cli.viewers.viewer_settings import Network
from tests.references.streaming import NaiveCache, Twin, roots_first, sized

MB = 1_000_000
networks = st.builds(
    Network,
    bandwidth=st.integers(1, 50).map(lambda k: k * 997.0),
    latency=st.integers(0, 400).map(lambda ms: ms / 1000),
    fetchers=st.integers(1, 5),
)
#: What has to come before the chunks of each tree: nothing, or one answer or more.
headers = st.lists(st.lists(st.integers(1, 4000), max_size=3), min_size=3, max_size=3)
tree_sizes = st.lists(st.lists(st.integers(1, 9999), min_size=1, max_size=6), min_size=1, max_size=3)


def resident(cache: ChunkCache) -> set[int]:
    present = set(np.flatnonzero(cache.resident()).tolist())
    assert int(cache.resident().sum()) == len(present)
    assert all((chunk in cache) == (chunk in present) for chunk in range(len(cache.resident())))
    return present


#: What each chunk file takes: an answer, or one and several after it.
file_requests = st.lists(
    st.lists(st.lists(st.integers(1, 9999), min_size=1, max_size=4).map(tuple), min_size=1, max_size=4),
    min_size=1,
    max_size=3,
)


@settings(max_examples=400)  # faults here take several steps that suit each other
@given(st.data(), tree_sizes, headers, networks)
@pytest.mark.slow
def test_a_stream_of_trees_agrees_with_its_twin(
    data: st.DataObject, sizes: list[list[int]], headers: list[list[int]], network: Network
) -> None:
    check_twin(data, sized(sizes, headers[: len(sizes)]), network)


@settings(max_examples=400)
@given(st.data(), file_requests, headers, networks, st.none() | st.integers(1, 5))
@pytest.mark.slow
def test_a_stream_of_files_of_several_requests_agrees_with_its_twin(
    data: st.DataObject,
    requests: list[list[tuple[int, ...]]],
    headers: list[list[int]],
    network: Network,
    connections: int | None,
) -> None:
    chunks = Chunks(requests, headers[: len(requests)], rooted=False, fetchers=2, connections=connections)
    check_twin(data, chunks, network)


def check_twin(data: st.DataObject, chunks: Chunks, network: Network) -> None:
    """Asserts that a stream agrees with its twin in what arrives, in which order and when."""
    capacity = data.draw(st.none() | st.integers(len(chunks.firsts), len(chunks.sizes)))
    stream, twin = ChunkStream(chunks, network, capacity=capacity), Twin(chunks, network, NaiveCache(capacity))
    seen: list[int] = []
    for _ in range(data.draw(st.integers(1, 8))):
        requested = data.draw(st.lists(st.integers(0, len(chunks.sizes) - 1), max_size=12))
        stream.want(requested)
        twin.want(requested)
        time = stream.now + data.draw(st.integers(1, 3000)) / 1009
        twin.advance(Fraction(time))
        assume(not twin.tied)
        stream.advance(time)
        seen += stream.take_arrivals()
        assert seen == [chunk for _, chunk in twin.arrivals]
        assert stream.received == twin.received
        assert resident(stream.cache) == set(twin.cache.used)
        assert capacity is None or len(resident(stream.cache)) <= capacity
    complete_in = stream.complete_in(requested)
    if capacity is not None and len(twin.cache.requested) > capacity:
        assert complete_in is None
    else:
        assert complete_in is not None
        missing = set(twin.cache.requested) - set(twin.cache.used)
        known = len(twin.arrivals)
        twin.advance(twin.now + 1000)
        last = max((time for time, chunk in twin.arrivals[known:] if chunk in missing), default=Fraction(stream.now))
        assert complete_in == pytest.approx(float(last) - stream.now, rel=1e-9, abs=1e-9)


def test_a_file_waits_for_its_first_request_then_for_the_others_and_for_connections() -> None:
    """Three answers of 300 bytes at 100 bytes/s by two connections, each after half a second."""
    chunks = Chunks([[(100, 300, 300, 300)]], [()], rooted=False, fetchers=1, connections=2)
    stream = ChunkStream(chunks, Network(100.0, 0.5))
    # The first until 1.5 s, two more from 2 s to 8 s, both at once, the last from 8.5 s to 11.5 s.
    assert stream.complete_in([0]) == pytest.approx(11.5)
    free = Chunks([[(100, 300, 300, 300)]], [()], rooted=False, fetchers=1, connections=None)
    assert ChunkStream(free, Network(100.0, 0.5)).complete_in([0]) == pytest.approx(11.0)


@given(st.data(), tree_sizes, networks)
def test_every_byte_comes_once_and_never_faster_than_the_link(
    data: st.DataObject, sizes: list[list[int]], network: Network
) -> None:
    chunks = sized(sizes)
    stream = ChunkStream(chunks, network)
    stream.want(data.draw(st.permutations(range(len(chunks.sizes)))))
    arrived: list[int] = []
    before = 0
    while len(arrived) < len(chunks.sizes):
        start = stream.now
        stream.advance(start + data.draw(st.integers(1, 4000)) / 1000)
        arrived += stream.take_arrivals()
        so_far = sum(chunks.sizes[chunk] for chunk in arrived)
        assert so_far <= network.bandwidth * max(0.0, stream.now - network.latency) * (1 + 1e-9)
        under_way = network.fetchers * max(chunks.sizes)  # of which most may have come before
        assert so_far - before <= network.bandwidth * (stream.now - start) + under_way
        before = so_far
    assert sorted(arrived) == list(range(len(chunks.sizes)))
    assert before == sum(map(sum, sizes))
    stream.advance(stream.now + 1000)
    assert stream.take_arrivals() == []


@given(st.data(), tree_sizes, networks)
def test_the_number_of_time_steps_does_not_matter(
    data: st.DataObject, sizes: list[list[int]], network: Network
) -> None:
    chunks = sized(sizes)
    one, many = (ChunkStream(chunks, network, capacity=len(sizes) + 2) for _ in range(2))
    for _ in range(3):
        requested = data.draw(st.lists(st.integers(0, len(chunks.sizes) - 1), max_size=12))
        one.want(requested)
        many.want(requested)
        start, stop = one.now, one.now + data.draw(st.floats(0.001, 3))
        for time in sorted(data.draw(st.lists(st.floats(start, stop), max_size=20))):
            many.advance(time)
            many.complete_in(
                data.draw(st.lists(st.integers(0, len(chunks.sizes) - 1), max_size=5))
            )  # looks, changes nothing
        many.advance(stop)
        one.advance(stop)
        assert many.take_arrivals() == one.take_arrivals()
        assert resident(many.cache) == resident(one.cache)
        assert many.complete_in(requested) == one.complete_in(requested)  # to the last bit


@given(tree_sizes, networks)
def test_the_predicted_completion_is_when_all_is_there(sizes: list[list[int]], network: Network) -> None:
    chunks = sized(sizes)
    stream = ChunkStream(chunks, network, start=5.0)
    requested = list(range(len(chunks.sizes)))
    stream.want(requested)
    left = stream.complete_in(requested)
    assert left is not None and left > 0
    stream.advance(5 + left * (1 - 1e-9))
    assert stream.cache.missing()
    stream.advance(5 + left * (1 + 1e-9))
    assert not stream.cache.missing()
    assert stream.complete_in(requested) == 0


@given(tree_sizes, networks, st.floats(1, 10))
def test_with_more_bandwidth_a_resting_camera_waits_no_longer(
    sizes: list[list[int]], network: Network, factor: float
) -> None:
    """One fetcher, or one for each chunk, or no latency, or chunks of one size."""
    chunks = sized(sizes)
    even = sized([[sizes[0][0]] * len(tree) for tree in sizes])
    requested = list(range(len(chunks.sizes)))
    for case, latency, fetchers in (
        (chunks, network.latency, 1),
        (chunks, network.latency, len(chunks.sizes)),
        (chunks, 0.0, network.fetchers),
        (even, network.latency, network.fetchers),
    ):
        slow = ChunkStream(case, Network(network.bandwidth, latency, fetchers)).complete_in(requested)
        fast = ChunkStream(case, Network(network.bandwidth * factor, latency, fetchers)).complete_in(requested)
        assert slow is not None and fast is not None
        assert fast <= slow * (1 + 1e-9)


@given(st.data(), tree_sizes, networks)
def test_one_fetcher_brings_them_in_order_one_after_the_other(
    data: st.DataObject, sizes: list[list[int]], network: Network
) -> None:
    chunks = sized(sizes)
    stream = ChunkStream(chunks, Network(network.bandwidth, network.latency, 1))
    requested = data.draw(st.permutations(range(len(chunks.sizes))))
    stream.want(requested)
    order = roots_first(chunks, requested)
    time = np.cumsum([network.latency + chunks.sizes[chunk] / network.bandwidth for chunk in order])
    assert stream.complete_in(requested) == pytest.approx(time[-1])
    stream.advance(time[-1] * 1.001)
    assert stream.take_arrivals() == order


def test_a_chunk_is_requested_after_the_header_and_arrives_at_its_time() -> None:
    """The header takes no fetcher, and what it brings of the first chunk is not counted as the chunk."""
    stream = ChunkStream(sized([[MB]]), Network(2.5 * MB, 0.06))
    assert stream.complete_in([0]) == pytest.approx(0.06 + 0.4)
    stream.want([])  # a root is always wanted
    stream.advance(0.459)
    assert stream.take_arrivals() == []
    stream.advance(0.461)
    assert stream.take_arrivals() == [0]
    assert stream.complete_in([0]) == 0
    stream = ChunkStream(sized([[MB, MB]], [[MB // 2]]), Network(MB, 0.1, 1))
    stream.want([])
    stream.advance(0.599)
    assert stream.take_bytes() == 0
    stream.advance(0.601)
    assert (stream.take_bytes(), stream.take_arrivals()) == (MB // 2, [])
    assert stream.complete_in([0, 1]) == pytest.approx(0.6 + 1.1 + 1.1 - 0.601)
    stream.advance(1.701)
    assert (stream.take_bytes(), stream.take_arrivals()) == (MB, [0])


@given(st.data(), tree_sizes)
def test_the_default_network_brings_at_once_what_fits(data: st.DataObject, sizes: list[list[int]]) -> None:
    sizes = [[0 if size % 3 else size for size in tree] for tree in sizes]  # some of no bytes
    chunks = sized(sizes)
    capacity = data.draw(st.none() | st.integers(len(sizes), len(chunks.sizes)))
    stream = ChunkStream(chunks, capacity=capacity)
    for time in range(data.draw(st.integers(1, 6))):
        stream.advance(time)
        assert stream.take_arrivals() == []
        before = resident(stream.cache)
        requested = data.draw(st.lists(st.integers(0, len(chunks.sizes) - 1), max_size=12))
        stream.want(requested)
        admitted = roots_first(chunks, requested)[:capacity]
        assert set(stream.take_arrivals()) == set(admitted) - before
        assert set(admitted) <= resident(stream.cache) <= set(admitted) | before
        if capacity is not None:
            assert int(stream.cache.resident().sum()) == min(capacity, len(before | set(admitted)))
        stream.want(requested)  # nothing goes in and out within a frame
        assert stream.take_arrivals() == []
        fits = capacity is None or len(roots_first(chunks, requested)) <= capacity
        assert stream.complete_in(requested) == (0.0 if fits else None)


@settings(max_examples=400)
@given(st.data())
@pytest.mark.slow
def test_the_least_recently_used_chunk_is_evicted(data: st.DataObject) -> None:
    trees = data.draw(st.lists(st.integers(1, 5), min_size=1, max_size=3))
    chunks = sized([[1] * count for count in trees])
    capacity = data.draw(st.none() | st.integers(len(trees), len(chunks.sizes) + 1))
    cache, naive = ChunkCache(chunks, capacity), NaiveCache(capacity)
    numbers = st.integers(0, len(chunks.sizes) - 1)
    rooted = False
    for _ in range(data.draw(st.integers(1, 25))):
        absent = [chunk for chunk in range(len(chunks.sizes)) if chunk not in cache]
        if absent and data.draw(st.booleans()):
            chunk = data.draw(st.sampled_from(absent))
            importance = {each: -place for place, each in enumerate(cache.requested)}
            before = resident(cache)
            evicted = cache.arrive(chunk)
            assert evicted == naive.arrive(chunk)
            assert evicted not in cache.admitted
            assert resident(cache) == (before | {chunk}) - {evicted}
            if evicted in importance:  # all that are here are wanted, and it is the least important of them
                assert importance[evicted] == min(importance[each] for each in before | {chunk})
        else:
            requested = data.draw(st.lists(numbers, max_size=10))
            cache.want(requested)
            rooted = True
            assert cache.requested == roots_first(chunks, requested)
            assert cache.admitted == cache.requested[:capacity]
            naive.want(cache.requested)
        assert resident(cache) == set(naive.used)
        assert int(cache.resident().sum()) <= naive.capacity
        assert cache.missing() == [chunk for chunk in cache.admitted if chunk not in naive.used]
        assert not rooted or set(chunks.roots) <= set(cache.admitted)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: ChunkCache(sized([[1], [1, 1]]), 1), "the roots of 2 trees"),
        (lambda: Network(0.0, 0.0, 3), "bandwidth is 0"),
        (lambda: Network(math.nan, 0.0, 3), "bandwidth is nan"),
        (lambda: Network(1.0, -1.0, 3), "latency is -1"),
        (lambda: Network(1.0, math.inf, 3), "latency is inf"),
        (lambda: Network(1.0, 0.0, 0), "fetchers is 0"),
        *(
            (lambda time=time: ChunkStream(sized([[1]]), start=1.0).advance(time), "it must increase")
            for time in (0.5, math.nan, math.inf)
        ),
    ],
)
def test_small_caches_impossible_times_and_networks_are_refused(act: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        act()


def test_a_viewer_asks_for_more_until_the_header_is_whole() -> None:
    kb, mb = 1 << 10, 1 << 20
    assert header_answers(0, 9 * mb) == ()
    assert header_answers(1, 9 * mb) == header_answers(64 * kb, 9 * mb) == (64 * kb,)
    assert header_answers(64 * kb + 1, 9 * mb) == (64 * kb, 256 * kb)
    assert header_answers(300 * kb, 9 * mb) == (64 * kb, 256 * kb, mb)
    assert header_answers(1_616, 1_616) == (1_616,)  # a file that names others and has nothing but the header
