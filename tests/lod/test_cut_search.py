"""Cuts found by several threads are those of one queue, as those of one thread are."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparklod_cli.lod import cut_search
from sparklod_cli.lod.cut_search import CutSearch, Found
from sparklod_cli.lod.kernels.cut_arrays import Trees
from sparklod_cli.lod.traversal import Traversal, TreeCut, TreeInstance, View
from sparklod_cli.model.nodes import Nodes
from tests.lod.forests import Case, cases, check, drawn, links, random_tree, transform, views
from tests.lod.test_traversal import large_case

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def always_together() -> Iterator[None]:
    """Several threads find cuts of any size, and deal out subtrees after a few nodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cut_search, "PARALLEL_BUDGET", 0)
        patch.setattr(cut_search, "TOP_NODES", 2)
        yield


def find(case: Case, threads: int, found: Traversal | None = None) -> TreeCut:
    found = found or case.traversal()
    return found.cut(case.view, budget=case.budget, smallest=case.smallest, threads=threads)


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Of each cut for which several threads were asked, whether they found it."""
    answers, original = [], CutSearch._find_together

    def watched(self: CutSearch, trees: Trees, *rest: object) -> Found | None:
        found = original(self, trees, *rest)
        answers.append(found is not None)
        return found

    monkeypatch.setattr(CutSearch, "_find_together", watched)
    return answers


@given(cases(), st.integers(2, 4), st.data())
@settings(max_examples=50)
def test_cuts_of_several_threads_are_those_of_one_queue(case: Case, threads: int, data: st.DataObject) -> None:
    """The first, and those that begin with the threshold of the one before."""
    found = case.traversal()
    for _ in range(2):
        check(case, find(case, threads, found))
        budget = data.draw(st.integers(len(case.instances), case.most + 3))
        case = dataclasses.replace(case, view=data.draw(views(case.trees)), budget=budget)


@given(cases(), st.data())
def test_nan_and_infinity_give_the_same_cut_to_several_threads(case: Case, data: st.DataObject) -> None:
    bad = st.sampled_from([math.nan, math.inf, -math.inf, 65504.0, 3e38, 1e-45])
    for tree in case.trees:
        for node in data.draw(st.lists(st.integers(0, len(tree.size) - 1), max_size=4)):
            tree.size[node] = abs(data.draw(bad))
    check(case, find(case, 3))


def told(cut: TreeCut) -> tuple[object, ...]:
    """All that a cut says, whatever the order of its nodes."""
    order = np.lexsort((cut.node, cut.instance))
    columns = [column[order].tolist() for column in (cut.instance, cut.node, cut.limit)]
    return *columns, cut.reason, cut.missing, cut.least, cut.stop, cut.wanted.tolist()


@pytest.fixture(scope="module")
def large() -> Case:
    """Three instances of two trees."""
    return large_case(5, nodes=60_000)


@pytest.mark.parametrize("threads", [2, 3, 4])
def test_cuts_of_large_trees_are_those_of_one_thread(threads: int, large: Case, together: list[bool]) -> None:
    case = large
    found = case.traversal()
    for budget, smallest in [(3, 0.0), (20_000, 0.0), (1_000, 0.0), (20_000, 0.02), (200_000, 0.0), (10**6, 0.0)]:
        case = dataclasses.replace(case, budget=budget, smallest=smallest)
        assert told(find(case, threads, found)) == told(find(case, 1))
    assert together == [True] * 6


@pytest.mark.parametrize("top", [1, 1_000, 100_000])
def test_the_cut_does_not_depend_on_where_subtrees_are_dealt_out(
    top: int, large: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cut_search, "TOP_NODES", top)
    assert told(find(large, 2)) == told(find(large, 1))


class InOrder:
    """Runs what it is given at once, before the first part, or only when the outcome is asked for, after it."""

    def __init__(self, first: bool) -> None:
        self._first = first

    def submit(self, work: Callable[..., object], *arguments: object) -> Future[object]:
        future: Future[object] = Future()
        if self._first:
            future.set_result(work(*arguments))
        else:
            future.result = lambda timeout=None: work(*arguments)
        return future


@pytest.mark.parametrize("first", [False, True])
@given(case=cases())
def test_it_does_not_matter_which_thread_is_faster(first: bool, case: Case) -> None:
    """Other parts are taken all before the first, or all after it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cut_search, "ThreadPoolExecutor", lambda threads: InOrder(first))
        check(case, find(case, 3))


def test_small_budgets_are_left_to_one_thread(
    large: Case, monkeypatch: pytest.MonkeyPatch, together: list[bool]
) -> None:
    monkeypatch.setattr(cut_search, "PARALLEL_BUDGET", large.budget + 1)
    find(large, 2)
    assert together == []
    find(dataclasses.replace(large, budget=large.budget + 1), 2)
    assert together == [True]


def test_a_tree_that_is_one_chain_is_left_to_one_thread(together: list[bool]) -> None:
    """All of it is in one part, whose buffers have room for its share alone."""
    length = 300_000
    tree = links([1] * length + [2] + [1] * 2000)
    size = np.linspace(1, 0.5, len(tree)).astype(np.float32)
    view = View(np.diag([1.0, 1, 1, 1]) + np.array([[0.0] * 4, [0] * 4, [0, 0, 0, 2], [0] * 4]), 1.4, 1.0)
    case = Case([Nodes(np.zeros((len(tree), 3), np.float32), size, tree)], [TreeInstance()], view, 2, 0.0)
    assert sorted(find(case, 2).node.tolist()) == sorted(case.find().node.tolist()) == [len(tree) - 2, len(tree) - 1]
    assert together == [False]


def test_missing_chunks_are_left_to_one_thread(together: list[bool]) -> None:
    rng = np.random.default_rng(0)
    case = Case([random_tree(rng, 150_000, 5)], [TreeInstance()], View(transform(rng), 1.4, 1.0), 30_000, 0.0)
    found = case.traversal()
    there = np.array([True, False, True])
    cut = found.cut(case.view, budget=case.budget, resident=there, threads=2)
    assert sorted(drawn(cut)) == sorted(drawn(case.find(resident=there)))
    assert together == []
