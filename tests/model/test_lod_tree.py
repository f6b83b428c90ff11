"""Invariants of trees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.system.errors import TreeError


def tree_of(counts: list[int], starts: list[int]) -> LodTree:
    return LodTree(np.array(counts, np.uint16), np.array(starts, np.uint32))


@st.composite
def trees(draw: st.DrawFn) -> LodTree:
    """Any tree in breadth-first order."""
    counts, starts, node = [0], [0], 0
    while node < len(counts) and len(counts) < 60:
        counts[node] = draw(st.integers(0, 4))
        if counts[node]:
            starts[node] = len(counts)
            counts += [0] * counts[node]
            starts += [0] * (len(counts) - len(starts))
        node += 1
    return tree_of(counts, starts)


@given(trees())
def test_a_tree_is_valid_and_depths_are_those_of_its_edges(tree: LodTree) -> None:
    tree.validate()
    depth = tree.depths()
    assert depth[0] == 0
    for node in range(len(tree)):
        start = int(tree.child_start[node])
        assert (depth[start : start + int(tree.child_count[node])] == depth[node] + 1).all()


@given(trees(), st.data())
def test_any_single_change_is_noticed(tree: LodTree, data: st.DataObject) -> None:
    node = data.draw(st.integers(0, len(tree) - 1))
    count, start = tree.child_count.copy(), tree.child_start.copy()
    if data.draw(st.booleans()):
        count[node] = data.draw(st.integers(0, 9).filter(lambda value: value != count[node]))
    else:
        node = data.draw(st.sampled_from(np.flatnonzero(count).tolist() or [None]))
        assume(node is not None)
        start[node] = data.draw(st.integers(0, 99).filter(lambda value: value != start[node]))
    with pytest.raises(TreeError):
        LodTree(count, start).validate()


@pytest.mark.parametrize(
    ("counts", "starts", "message"),
    [
        ([], [], "no node"),
        ([0, 0], [0, 0], "node 1 has no parent"),
        ([1, 1], [1, 1], "node 1 comes after one of its children"),
        ([2, 0, 0], [0, 0, 0], "node 0 comes after one of its children"),
        ([3, 0, 0], [1, 0, 0], "node 0 has children past the last node"),
        ([2, 1, 1, 0], [1, 3, 3, 0], "shares children"),
        ([65535, 0], [1, 0], "past the last node"),
        ([1, 0], [4294967295, 0], "past the last node"),
    ],
)
def test_each_fault_is_named(counts: list[int], starts: list[int], message: str) -> None:
    with pytest.raises(TreeError, match=message):
        tree_of(counts, starts).validate()


def test_the_start_of_a_leaf_means_nothing() -> None:
    tree = tree_of([2, 0, 0], [1, 7, 2])
    tree.validate()
    assert tree.first_child().tolist() == [1, 0, 0]


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(TreeError, match="2 child counts but 1"):
        LodTree(np.zeros(2, np.uint16), np.zeros(1, np.uint32)).validate()
