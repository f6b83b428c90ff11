"""Cuts through trees of which chunks are missing, against one plain queue."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.model import lod_tree
from sparklod_cli.viewers import spark as traversal
from sparklod_cli.viewers.cut import Forest, TreeInstance
from tests.lod.forests import Case, ancestors_drawn, cases, check, random_tree, transform
from tests.lod.sights import CutView

#: Nodes of a chunk in tests of small trees, as a power of 2; so large that no node's children are in three.
SMALL = 4


@pytest.fixture(scope="class")
def small_chunks() -> Iterator[None]:
    """Small chunks, so that small trees have many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(traversal, "CHUNK_BITS", SMALL)
        for module in (traversal, lod_tree):
            patch.setattr(module, "CHUNK_NODES", 1 << SMALL)
        yield


def some_chunks(data: st.DataObject, forest: Forest) -> np.ndarray:
    """Which chunks are there: most of them, but for a few."""
    there = np.ones(forest.chunks, np.bool_)
    gone = data.draw(st.sets(st.integers(0, forest.chunks - 1), max_size=max(1, forest.chunks // 2)))
    there[list(gone)] = False
    return there


@pytest.mark.usefixtures("small_chunks")
class TestSmallChunks:
    @given(cases(60), st.data())
    @settings(max_examples=300)
    def test_the_cut_with_missing_chunks_is_that_of_one_queue(self, case: Case, data: st.DataObject) -> None:
        """Also where other chunks were there before."""
        found = case.traversal()
        for _ in range(data.draw(st.integers(1, 3))):
            there = some_chunks(data, found.forest)
            check(case, case.find(found, there), there, SMALL)

    @given(cases(60), st.data())
    def test_every_leaf_of_a_resident_root_is_drawn_once(self, case: Case, data: st.DataObject) -> None:
        """Of each instance whose root is there."""
        found = case.traversal()
        there = some_chunks(data, found.forest)
        cut = case.find(found, there)
        assert len(cut) <= case.budget
        for instance, nodes in zip(case.instances, cut.indices(), strict=True):
            tree = case.trees[instance.tree].tree
            root = there[found.forest.chunk_base[instance.tree]]
            assert (ancestors_drawn(tree, nodes)[tree.is_leaf] == root).all()
            chunks = found.forest.chunk_base[instance.tree] + (nodes >> SMALL)
            assert there[chunks].all()  # what is drawn is there

    @given(cases(60), st.data())
    def test_loading_the_wanted_chunks_in_turn_gives_the_whole_cut(self, case: Case, data: st.DataObject) -> None:
        """As a viewer fetches it: the roots, then always the most wanted chunk that is missing."""
        found = case.traversal()
        whole = case.find(found)
        there = np.zeros(found.forest.chunks, np.bool_)
        there[found.forest.chunk_base[[instance.tree for instance in case.instances]]] = True
        for _ in range(len(there) + 1):
            cut = case.find(found, there)
            assert set(cut.wanted()) >= set(np.flatnonzero(cut.demand > 0))
            lacking = [chunk for chunk in cut.wanted() if not there[chunk]]
            assert (cut.missing > 0) == bool(lacking)
            if not lacking:
                break
            there[lacking[0]] = True
        assert [nodes.tolist() for nodes in cut.indices()] == [nodes.tolist() for nodes in whole.indices()]
        assert cut.demand.tolist() == whole.demand.tolist()


@pytest.mark.parametrize("seed", range(2))
def test_the_cut_of_large_trees_with_missing_chunks_is_that_of_one_queue(seed: int) -> None:
    rng = np.random.default_rng(seed)
    trees = [random_tree(rng, 200_000, 6), random_tree(rng, 100_000, 3)]
    instances = [TreeInstance(tree, transform(rng, spread=2.0), 1.0 + tree) for tree in (0, 1, 0)]
    view = CutView(transform(rng, spread=4.0), math.radians(80), math.radians(60))
    case = Case(trees, instances, view, 30_000, 0.0)
    found = case.traversal()
    there = rng.random(found.forest.chunks) < 0.6
    there[found.forest.chunk_base[:-1]] = True, seed % 2
    for budget, smallest in [(30_000, 0.0), (3_000, 0.0), (30_000, 0.05)]:
        asked = dataclasses.replace(case, budget=budget, smallest=smallest)
        cut = asked.find(found, there)
        check(asked, cut, there)
        assert cut.missing >= 1 - seed % 2
    nobody = case.find(found, np.zeros_like(there))
    assert (len(nobody), nobody.missing, nobody.reason) == (0, 3, "missing")
    assert nobody.wanted() == []
