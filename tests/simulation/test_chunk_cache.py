"""Chunks: their order, and the cache against a list that is looked through."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.viewers.chunk_cache import ChunkCache
from sparklod_cli.viewers.spark import header_answers
from tests.references.streaming import NaiveCache, roots_first, sized


def here(cache: ChunkCache) -> set[int]:
    present = set(np.flatnonzero(cache.resident()).tolist())
    assert int(cache.resident().sum()) == len(present)
    assert all((chunk in cache) == (chunk in present) for chunk in range(len(cache.resident())))
    return present


@settings(max_examples=400)  # what goes wrong here takes several steps that suit each other
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
            before = here(cache)
            evicted = cache.arrive(chunk)
            assert evicted == naive.arrive(chunk)
            assert evicted not in cache.admitted
            assert here(cache) == (before | {chunk}) - {evicted}
            if evicted in importance:  # all that are here are wanted, and it is the least important of them
                assert importance[evicted] == min(importance[each] for each in before | {chunk})
        else:
            requested = data.draw(st.lists(numbers, max_size=10))
            cache.want(requested)
            rooted = True
            assert cache.requested == roots_first(chunks, requested)
            assert cache.admitted == cache.requested[:capacity]
            naive.want(cache.requested)
        assert here(cache) == set(naive.used)
        assert int(cache.resident().sum()) <= naive.capacity
        assert cache.missing() == [chunk for chunk in cache.admitted if chunk not in naive.used]
        assert not rooted or set(chunks.roots) <= set(cache.admitted)


def test_unwanted_late_arrivals_are_evicted_first() -> None:
    cache = ChunkCache(sized([[1, 1, 1], [1]]), 3)
    cache.want([])
    for chunk in (0, 3, 1):  # the last is not wanted, and there is room
        assert cache.arrive(chunk) is None
    cache.want([2])
    assert cache.arrive(2) == 1
    cache = ChunkCache(sized([[1, 1, 1], [1]]), 3)
    cache.want([2])
    assert [cache.arrive(chunk) for chunk in (0, 3, 1, 2)] == [None, None, None, 1]


def test_a_copy_of_a_cache_is_independent() -> None:
    cache = ChunkCache(sized([[1, 1, 1]]), 2)
    cache.want([1])
    cache.arrive(0)
    twin = cache.copy()
    twin.arrive(1)
    twin.want([2])
    assert twin.arrive(2) == 1
    assert here(cache) == {0}
    assert cache.requested == [0, 1]


def test_wanted_may_be_an_array() -> None:
    cache = ChunkCache(sized([[1, 1, 1]]))
    cache.want(np.array([2, 1], np.uint32))
    assert cache.requested == [0, 2, 1]
    assert all(type(chunk) is int for chunk in cache.requested)


@pytest.mark.parametrize("requested", [[3], [-1], [0, 1, 7]])
def test_a_chunk_that_no_tree_has_cannot_be_wanted(requested: list[int]) -> None:
    with pytest.raises(ValueError, match="there are 3"):
        ChunkCache(sized([[1, 1], [1]])).want(requested)


def test_a_cache_smaller_than_the_roots_is_refused() -> None:
    chunks = sized([[1], [1, 1]])
    with pytest.raises(ValueError, match="the roots of 2 trees"):
        ChunkCache(chunks, 1)
    ChunkCache(chunks, 2)


def test_chunks_are_numbered_across_trees() -> None:
    chunks = sized([[5, 6], [7], [8, 9]])
    assert chunks.sizes == [5, 6, 7, 8, 9]
    assert chunks.roots == [0, 2, 3]
    assert len(chunks.sizes) == 5


@pytest.mark.parametrize("sizes", [[[1], []], [[1], [2, -1]]])
def test_impossible_chunk_sizes_are_refused(sizes: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="chunks of tree 1"):
        sized(sizes)


def test_a_viewer_asks_for_more_until_the_header_is_whole() -> None:
    kb, mb = 1 << 10, 1 << 20
    assert header_answers(0, 9 * mb) == ()
    assert header_answers(1, 9 * mb) == header_answers(64 * kb, 9 * mb) == (64 * kb,)
    assert header_answers(64 * kb + 1, 9 * mb) == (64 * kb, 256 * kb)
    assert header_answers(300 * kb, 9 * mb) == (64 * kb, 256 * kb, mb)
    assert header_answers(1_616, 1_616) == (1_616,)  # a file that names others and has nothing but the header


def test_headers_are_of_trees() -> None:
    with pytest.raises(ValueError, match="there are 2 headers of 1 trees"):
        sized([[1]], [[1], [2]])
