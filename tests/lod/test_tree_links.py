"""The kernels that follow the links of broken trees against slow, obvious twins."""

from __future__ import annotations

import os
import subprocess
import sys
from random import Random

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels.tree_links import (
    LIMIT_BITS,
    MAX_LINKS,
    add_weighted,
    count_limits,
    fill_weights,
    find_cycles,
    find_depths,
    find_limits,
    find_parents,
    mark_small,
    sum_by_depth,
)
from sparklod_cli.model.gaussian import spark_size
from tests.conftest import ROOT
from tests.references import gaussians, tree_links
from tests.scenes import random_splats

Links = list[tuple[int, int]]

#: Child counts and child starts as good trees have them, and as broken files do.
COUNTS = st.one_of(st.integers(0, 4), st.sampled_from([0, 0, 255, 65535]))
STARTS = st.one_of(st.integers(0, 40), st.sampled_from([0, 65536, 2**31 - 1, 2**31, 2**32 - 1]))
ANY_LINKS = st.lists(st.tuples(COUNTS, STARTS), min_size=1, max_size=40)


def arrays(links: Links) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts, starts, and sizes that differ from node to node."""
    count, start = zip(*links, strict=True)
    sizes = np.random.default_rng(len(links)).permutation(len(links)).astype(np.float32) + 1
    return np.array(count, np.uint16), np.array(start, np.uint32), sizes


def followed(links: Links) -> int:
    """Links to nodes that there are."""
    return sum(map(len, tree_links.links_of(*arrays(links)[:2])))


@st.composite
def trees(draw: st.DrawFn) -> Links:
    """Any tree, breadth first."""
    links = [(0, 0)]
    for node in range(20):
        if node < len(links):
            children = draw(st.integers(0, 4))
            links[node] = (children, len(links) if children else 0)
            links += [(0, 0)] * children
    return links


@st.composite
def broken_trees(draw: st.DrawFn) -> Links:
    """A tree of which some nodes say something else."""
    links = draw(trees())
    for node in draw(st.lists(st.integers(0, len(links) - 1), min_size=1, max_size=3)):
        links[node] = draw(st.tuples(COUNTS, STARTS))
    return links


ANY = st.one_of(trees(), broken_trees(), ANY_LINKS)


@given(ANY)
@example([(1, 0)])
@example([(2, 1), (65535, 2**32 - 1), (2, 3), (0, 0), (0, 0)])
def test_every_node_is_visited_once_by_the_shortest_way(links: Links) -> None:
    count, start, size = arrays(links)
    depth, limit = find_depths(count, start, size)
    expected = tree_links.follow(count, start, size)
    if followed(links) <= MAX_LINKS * len(links):
        assert depth.tolist() == expected.depth
        assert limit.tolist() == expected.limit
    else:  # nodes share so many children that some of them are not looked at
        known = depth >= 0
        assert depth[known].tolist() == np.array(expected.depth)[known].tolist()
        assert limit[known].tolist() == np.array(expected.limit)[known].tolist()


@given(ANY)
def test_parents_are_those_that_have_a_node_as_a_child(links: Links) -> None:
    count, start, size = arrays(links)
    parent, references = find_parents(count, start)
    expected = tree_links.follow(count, start, size).parents
    assert references.tolist() == [len(parents) for parents in expected]
    for found, parents in zip(parent.tolist(), expected, strict=True):
        assert found in parents or found == -1
        assert found != -1 or not parents or followed(links) > MAX_LINKS * len(links)


@given(st.lists(st.tuples(st.integers(-1, 29), st.sampled_from([-1, -1, -1, 0, 2])), min_size=1, max_size=30))
def test_cycles_are_found_by_following_parents(nodes: Links) -> None:
    parent = [above if above < len(nodes) else -1 for above, _ in nodes]
    depth = [edges for _, edges in nodes]
    found = find_cycles(np.array(parent, np.int32), np.array(depth, np.int32))
    assert found.tolist() == tree_links.on_cycles(parent, depth)


@given(ANY, st.integers(0, 2**32 - 1))
def test_children_count_by_what_they_cover(links: Links, seed: int) -> None:
    count, start, _ = arrays(links)
    splats = random_splats(len(links), seed=seed % 1000)
    rng = np.random.default_rng(seed)
    for column in (splats.opacity, splats.scale, splats.scale[:, 1:]):
        column[rng.random(len(links)) < 0.2] = 0
    parent, size = find_parents(count, start)[0], spark_size(splats)
    sums, weights = np.zeros(len(links)), np.zeros(len(links))
    for part in (slice(0, len(links) // 2), slice(len(links) // 2, None)):
        weight = np.empty(len(size[part]))
        fill_weights(parent[part], size[part], splats.scale[part], splats.opacity[part], weight)
        add_weighted(parent[part], size[part], weight, sums, weights)
    found = np.divide(sums, weights, out=np.zeros(len(links)), where=weights > 0)
    for node in range(len(links)):
        below = np.flatnonzero((parent == node) & (splats.opacity > 0) & (size > 0))
        if len(below):
            # The thinnest of needles count for something.
            scale = np.maximum(splats.scale[below], 1e-20 * splats.scale[below].max(axis=1, keepdims=True))
            weight = splats.opacity[below] * gaussians.ellipsoid_area(scale)
            assert found[node] == pytest.approx(np.average(size[below], weights=weight), rel=1e-4)
        else:
            assert found[node] == 0


@given(ANY)
def test_sums_over_levels_count_every_node_once(links: Links) -> None:
    count, start, size = arrays(links)
    depth, _ = find_depths(count, start, size)
    nodes, leaves, logs, children = sum_by_depth(depth, count, size)
    for level in range(int(depth.max()) + 1):
        there = depth == level
        assert nodes[level] == there.sum()
        assert leaves[level] == (there & (count == 0)).sum()
        assert logs[level] == pytest.approx(np.log(size[there].astype(np.float64)).sum(), rel=1e-6, abs=1e-6)
    assert len(nodes) == len(leaves) == len(logs) == depth.max() + 1
    assert np.array_equal(children, np.bincount(count, minlength=65536))


@pytest.mark.parametrize("start", [0, 1, 100_000])
def test_overlapping_children_take_no_longer(start: int) -> None:
    """Followed one by one these were 2 * 10 ** 11."""
    nodes = 3_000_000
    count, begin = np.full(nodes, 65535, np.uint16), np.full(nodes, start, np.uint32)
    depth, _ = find_depths(count, begin, np.ones(nodes, np.float32))
    assert depth[0] == 0
    assert depth[max(1, start)] == 1
    _, references = find_parents(count, begin)
    assert np.count_nonzero(references) == 65535
    assert references.max() == nodes


def test_a_tree_that_is_a_chain_is_followed_to_its_end() -> None:
    nodes = 200_000
    count = np.ones(nodes, np.uint16)
    count[-1] = 0
    start = np.arange(1, nodes + 1, dtype=np.uint32)
    depth, limit = find_depths(count, start, np.arange(nodes, 0, -1, dtype=np.float32))
    assert np.array_equal(depth, np.arange(nodes))
    assert np.array_equal(limit, np.arange(nodes, 0, -1))
    nodes_of, *_ = sum_by_depth(depth, count, np.ones(nodes, np.float32))
    assert (nodes_of == 1).all()


@pytest.mark.slow
def test_the_kernels_give_the_same_without_compilation() -> None:
    """A kernel that is debugged wraps no integers that the compiled one does not."""
    twins = (
        test_every_node_is_visited_once_by_the_shortest_way,
        test_parents_are_those_that_have_a_node_as_a_child,
        test_cycles_are_found_by_following_parents,
        test_sums_over_levels_count_every_node_once,
    )
    tests = [f"{__file__}::{test.__name__}" for test in twins]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests],
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


@given(ANY, st.integers(0, 3))
def test_inner_nodes_are_counted_by_their_limits(links: Links, chunk_bits: int) -> None:
    count, start, size = arrays(links)
    _, limit = find_depths(count, start, size)
    counts = np.zeros(1 << LIMIT_BITS, np.int64)
    split = count_limits(count, start, limit, chunk_bits, counts)
    chunks = [{child >> chunk_bits for child in (first, first + many - 1)} for many, first in links if many]
    assert split == sum(len(each) > 1 for each in chunks)
    inner = [node for node in range(len(links)) if count[node] and limit[node] > 0]
    buckets = [int(limit[node].view(np.uint32)) >> (32 - LIMIT_BITS) for node in inner]
    assert np.array_equal(counts, np.bincount(buckets, minlength=len(counts)))


@given(ANY, st.sampled_from([1 / 3, 1.0, 2.0]), st.randoms(use_true_random=False))
def test_nodes_much_smaller_than_a_child_are_marked(links: Links, ratio: float, random: Random) -> None:
    """All of them, and if links are too many to be followed, perhaps others."""
    count, start, size = arrays(links)
    size[random.randrange(len(size))] = random.choice([np.nan, np.inf, -1, 0])
    marks = np.zeros(len(links), np.bool_)
    marked = mark_small(count, start, size, ratio, marks)
    children = [
        [float(size[child]) for child in each if 0 < size[child] < np.inf] for each in tree_links.links_of(count, start)
    ]
    expected = np.array([own < ratio * max(each, default=0.0) for own, each in zip(size, children, strict=True)])
    assert marked == marks.sum()
    assert marks[expected].all()
    if followed(links) <= MAX_LINKS * len(links):
        assert np.array_equal(marks, expected)


@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_depth_and_limit_are_those_of_the_way_to_the_root(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(k) for k in range(1, count))], np.int32)
    size = rng.uniform(size=count).astype(np.float32)
    depth, limit = find_limits(parent, size)
    for family in range(count):
        way = [family]
        while parent[way[-1]] >= 0:
            way.append(int(parent[way[-1]]))
        assert depth[family] == len(way) - 1
        assert limit[family] == size[way].min()
