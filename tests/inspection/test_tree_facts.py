"""The facts of a tree and its faults, against brute force and by hand."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sparklod_cli.inspection import tree as facts_of
from sparklod_cli.inspection.findings import Finding
from sparklod_cli.inspection.tree import TreeFacts
from sparklod_cli.lod import quick
from sparklod_cli.lod.kernels.tree_links import find_depths
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.splats import Splats
from tests.inspection import examine_tree as examine
from tests.references import tree_links
from tests.scenes import random_splats

Links = list[tuple[int, int]]


def tree_of(links: Links) -> LodTree:
    count, start = zip(*links, strict=True)
    return LodTree(np.array(count, np.uint16), np.array(start, np.uint32))


def sized(sizes: list[float], opacity: float = 0.5) -> Splats:
    """Splats of these feature sizes."""
    splats = random_splats(len(sizes))
    scale = np.repeat(np.float32(sizes)[:, None] / 2, 3, axis=1)
    return dataclasses.replace(splats, scale=scale, opacity=np.full(len(sizes), opacity, np.float32))


def codes(findings: list[Finding]) -> set[str]:
    return {found.code for found in findings}


def check_facts(splats: Splats, tree: LodTree, facts: TreeFacts) -> None:
    """All but the coarse cut, node by node."""
    size = spark_size(splats).astype(np.float64)
    depth = tree_links.follow(tree.child_count, tree.child_start, size).depth
    counts = tree.child_count.tolist()
    leaves = sum(count == 0 for count in counts)
    assert (facts.leaves, facts.inner) == (leaves, len(counts) - leaves)
    assert facts.growth == round(len(counts) / max(1, leaves), 4)
    assert facts.depth == max(depth)
    assert len(facts.levels) == max(depth) + 1
    for edges, level in enumerate(facts.levels):
        there = [node for node, each in enumerate(depth) if each == edges]
        assert level.nodes == len(there)
        assert level.leaves == sum(counts[node] == 0 for node in there)
        mean = math.exp(sum(math.log(size[node]) for node in there) / len(there))
        assert level.size == pytest.approx(mean, rel=6e-4)  # four digits
    assert facts.children == {str(count): n for count, n in sorted(Counter(counts).items()) if count}
    more = sum(opacity > 1 for opacity in splats.opacity.tolist())
    assert facts.more_than_opaque == round(more / len(counts), 4)


@given(st.integers(1, 300), st.sampled_from([1.1, 1.5, 2.0]), st.integers(0, 2**32 - 1))
def test_facts_of_built_trees_are_those_of_every_node(count: int, base: float, seed: int) -> None:
    nodes, tree = quick.build(random_splats(count, seed=seed), base)
    facts, findings = examine(nodes, tree)
    check_facts(nodes, tree, facts)
    assert facts.depth == tree.depths().max()
    assert facts.leaves == count
    assert sum(level.nodes for level in facts.levels) == len(tree)
    assert findings == []


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 12)), min_size=1, max_size=12))
def test_facts_of_broken_trees_are_those_of_what_the_root_leads_to(links: Links) -> None:
    splats = random_splats(len(links), seed=len(links))
    tree = tree_of(links)
    facts, findings = examine(splats, tree)
    check_facts(splats, tree, facts)
    try:
        tree.validate()
    except Exception:
        broken = {"tree.root", "tree.range", "tree.order", "tree.shared", "tree.orphan", "tree.leaf-start"}
        assert codes(findings) & broken
    else:
        assert not codes(findings) - {"tree.single-child", "tree.size"}


@pytest.mark.parametrize("most", [1, 2, 5, 16, 64, 200])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_coarse_cut_divides_the_largest_first(most: int, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts_of, "CHUNK_NODES", most)
    nodes, tree = quick.build(random_splats(150, seed=seed), 1.3)
    facts, _ = examine(nodes, tree)
    cut = tree_links.coarse_cut(tree.child_count, tree.child_start, spark_size(nodes), most)
    assert facts.chunks == math.ceil(len(tree) / most)
    assert facts.chunks_of_coarse_cut == len({node // most for node in cut})


def is_cut(tree: LodTree, cut: set[int]) -> bool:
    """Whether each way from the root to a leaf has exactly one node of a set."""
    links = tree_links.links_of(tree.child_count, tree.child_start)

    def on_ways_from(node: int) -> set[int]:
        """How many nodes of the set the ways from here have."""
        below = set().union(*map(on_ways_from, links[node])) if links[node] else {0}
        return {(node in cut) + number for number in below}

    return on_ways_from(0) == {1}


@given(st.integers(1, 60), st.integers(0, 2**32 - 1), st.booleans())
@example(18, 32, False)
def test_the_coarse_cut_is_a_cut_whatever_the_sizes(most: int, seed: int, falling: bool) -> None:
    """A node that is larger than its parent waits for it."""
    rng = np.random.default_rng(seed)
    links: Links = [(0, 0)]
    for node in range(40):
        if node < len(links) and len(links) < 100:
            children = int(rng.integers(2, 5)) if rng.random() < 0.8 else 0
            links[node] = (children, len(links) if children else 0)
            links += [(0, 0)] * children
    size = rng.permutation(len(links)).astype(np.float32) + 1
    if falling:
        size = np.sort(size)[::-1].copy()
    tree = tree_of(links)
    _, limit = find_depths(tree.child_count, tree.child_start, size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(facts_of, "CHUNK_NODES", most)
        cut = set(facts_of._coarse_cut(tree, limit)[0].tolist())
    assert is_cut(tree, cut)
    assert len(cut) <= most
    expected = tree_links.coarse_cut(tree.child_count, tree.child_start, size, most)
    assert is_cut(tree, expected)
    if falling:
        assert cut == expected


@pytest.mark.parametrize(
    ("sizes", "links", "leaves", "growth", "levels", "expected"),
    [
        ([1.0], [(0, 0)], 1, 1.0, [1.0], set()),
        ([1.0, 0.0, 1.0], [(2, 1), (0, 0), (0, 0)], 2, 1.5, [1.0, None], set()),  # no mean of a size of 0
        ([1.0, 1.0], [(1, 1), (1, 0)], 0, 2.0, [1.0, 1.0], {"tree.root", "tree.order", "tree.single-child"}),
    ],
)
def test_facts_of_trees_without_edges_sizes_or_leaves(
    sizes: list[float], links: Links, leaves: int, growth: float, levels: list[float | None], expected: set[str]
) -> None:
    facts, findings = examine(sized(sizes), tree_of(links))
    assert (facts.leaves, facts.growth, [level.size for level in facts.levels]) == (leaves, growth, levels)
    assert codes(findings) == expected


def test_a_finding_counts_and_names_the_first() -> None:
    _, findings = examine(sized([4.0, 2.0, 1.0, 1.0, 1.0]), tree_of([(2, 1), (0, 0), (0, 0), (0, 0), (0, 5)]))
    orphans, starts = findings
    assert (orphans.code, orphans.index, orphans.count) == ("tree.orphan", 3, 2)
    assert orphans.message == "node 3 has no parent (and 1 more)"
    assert (starts.code, starts.index, starts.count, starts.severity) == ("tree.leaf-start", 4, 1, "warning")


@pytest.mark.parametrize(("size", "found"), [(0.99, True), (1.01, False), (3.0, False), (0.0, True)])
def test_a_node_smaller_than_a_share_of_its_children_is_a_finding(size: float, found: bool) -> None:
    child = 1 / facts_of.MIN_SIZE_RATIO
    splats = sized([100.0, size, child, child, 1000.0])
    splats.opacity[4] = 1e-10  # a large one that covers nearly nothing
    _, findings = examine(splats, tree_of([(2, 1), (2, 3), (0, 0), (0, 0), (0, 0)]))
    assert [(each.code, each.index) for each in findings] == ([("tree.size", 1)] if found else [])


@pytest.mark.parametrize("rise", [0.9, 1.1])
@pytest.mark.parametrize("nodes", [facts_of.MIN_NODES, facts_of.MIN_NODES + 3, 3000])
def test_a_rise_of_size_in_a_large_tree_is_a_finding(nodes: int, rise: float) -> None:
    """Half of the leaves below a small node, and half below one that is larger by a factor, which comes behind them."""
    half = (nodes - 3) // 2
    sizes = np.ones(nodes)
    sizes[:3] = 100, 10, 10 * facts_of.MAX_RISE * rise
    links = [(2, 1), (half, 3), (nodes - 3 - half, 3 + half), *[(0, 0)] * (nodes - 3)]
    _, findings = examine(sized(sizes.tolist()), tree_of(links))
    if rise > 1 and nodes > facts_of.MIN_NODES:  # the root is not counted
        (found,) = findings
        assert (found.code, found.severity) == ("tree.coarse-first", "note")
        assert found.index == pytest.approx(nodes / 2, abs=nodes / facts_of.PARTS)
        assert found.count == nodes - found.index
    else:
        assert findings == []


def test_a_rise_is_found_although_a_node_has_no_parent() -> None:
    sizes = np.ones(3000)
    sizes[:3] = 100, 10, 20 * facts_of.MAX_RISE
    links = [(2, 1), (1498, 3), (1498, 1501), *[(0, 0)] * 2997]
    _, findings = examine(sized(sizes.tolist()), tree_of(links))
    assert codes(findings) == {"tree.orphan", "tree.coarse-first"}
    (found,) = (each for each in findings if each.code == "tree.coarse-first")
    assert found.index == pytest.approx(1500, abs=3000 / facts_of.PARTS)
