"""What is kept of a binary tree, and the tree that it makes."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod.kernels import prune
from sparklod_cli.model.lod_tree import LodTree

#: Of a place in the order that nobody has taken.
UNUSED = np.uint32(0xFFFFFFFF)


class Binary:
    """A random binary tree as it has grown: leaves first, then nodes after their children."""

    def __init__(self, leaves: int, seed: int, equal: bool) -> None:
        rng = np.random.default_rng(seed)
        total = 2 * leaves - 1
        self.leaves = leaves
        self.children = np.zeros((total, 2), np.uint32)
        self.size = np.ones(total, np.float32)
        self.error = np.zeros(total, np.float32)
        if not equal:
            self.size[:] = np.exp(rng.normal(0, 2, total))
            self.error[leaves:] = rng.uniform(0, 1, leaves - 1)
        left = list(range(leaves))
        for node in range(leaves, total):
            for side in range(2):
                self.children[node, side] = left.pop(int(rng.integers(len(left))))
            left.append(node)
            if not equal and rng.random() < 0.8:  # mostly larger than their children
                self.size[node] = self.size[self.children[node]].max() * rng.uniform(1, 2)
        self.log_size, self.weight, self.lost = (np.empty(total, np.float32) for _ in range(3))
        self.saved = np.empty(total, np.int32)
        self.parent = prune.fill_usefulness_terms(
            self.children, leaves, self.size, self.error, self.log_size, self.weight, self.lost
        )

    def drop(self, most: int) -> np.ndarray:
        """Drops; returns which are kept, leaves among them."""
        prune.drop_nodes(self.leaves, most, self.parent, self.log_size, self.weight, self.lost, self.saved)
        return np.flatnonzero(self.saved >= 0)

    def place(self) -> tuple[np.ndarray, LodTree, np.ndarray, np.ndarray]:
        """The node of each final index, the tree, inner nodes and their places."""
        level = prune.size_ranks(self.leaves, self.parent, self.log_size, self.saved)
        inner = np.flatnonzero(level >= 0).astype(np.uint32)
        inner = inner[np.argsort(level[inner], kind="stable")]
        total = self.leaves + len(inner)
        order = np.full(total, UNUSED)
        tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
        places = prune.lay_out_children(inner, self.parent, self.saved, order, tree.child_start, tree.child_count)
        return order, tree, inner, places


BINARIES = st.builds(Binary, st.integers(2, 150), st.integers(0, 2**32 - 1), st.booleans())


@given(BINARIES)
def test_every_node_is_valued_below_its_parent(binary: Binary) -> None:
    total = len(binary.size)
    assert binary.parent[total - 1] == total - 1
    for node in range(binary.leaves, total):
        assert (binary.parent[binary.children[node]] == node).all()
    expected = np.log(binary.size)
    for node in range(total - 2, -1, -1):
        expected[node] = min(expected[node], expected[binary.parent[node]])
    np.testing.assert_allclose(binary.log_size, expected, atol=1e-5)
    assert (binary.log_size <= binary.log_size[binary.parent]).all()
    inner = slice(binary.leaves, None)
    assert (binary.weight[inner] > 0).all() and (binary.weight[inner] <= 1).all()
    assert np.isfinite(binary.lost[inner]).all() and (binary.lost[inner] >= 0).all()


@given(BINARIES, st.floats(0, 1))
def test_no_more_are_kept_than_asked_for_and_their_parents_are_nearest_of_them(binary: Binary, share: float) -> None:
    most = max(1, int(share * (binary.leaves - 1)))
    above = binary.parent.copy()
    kept = binary.drop(most)
    root = len(above) - 1
    assert binary.saved[root] > 0
    assert (binary.saved[: binary.leaves] == 0).all()
    assert len(kept) - binary.leaves == min(most, binary.leaves - 1)  # neither more than wanted is dropped
    is_kept = binary.saved >= 0
    children = np.zeros(len(above), int)
    for node in kept[:-1]:
        nearest = above[node]
        while not is_kept[nearest]:
            nearest = above[nearest]
        assert binary.parent[node] == nearest
        children[nearest] += 1
    inner = kept[kept >= binary.leaves]
    assert np.array_equal(binary.saved[inner] + 1, children[inner])


def test_the_most_useful_nodes_are_kept() -> None:
    """Of two inner nodes under a root, equal but for their errors, the one with less of it."""
    children = np.array([[0, 0]] * 4 + [[0, 1], [2, 3], [4, 5]], np.uint32)
    for worse in (4, 5):
        size = np.array([1, 1, 1, 1, 2, 2, 8], np.float32)
        error = np.array([0, 0, 0, 0, 0.1, 0.1, 1], np.float32)
        error[worse] = 0.4
        log_size, weight, lost = (np.empty(7, np.float32) for _ in range(3))
        saved = np.empty(7, np.int32)
        parent = prune.fill_usefulness_terms(children, 4, size, error, log_size, weight, lost)
        prune.drop_nodes(4, 2, parent, log_size, weight, lost, saved)
        assert saved[worse] == -1
        assert saved[9 - worse] == 1
        assert saved[6] == 2


@given(BINARIES, st.floats(0, 1))
def test_levels_rise_along_every_path(binary: Binary, share: float) -> None:
    kept = binary.drop(max(1, int(share * (binary.leaves - 1))))
    level = prune.size_ranks(binary.leaves, binary.parent, binary.log_size, binary.saved)
    inner = kept[kept >= binary.leaves]
    assert level[inner[-1]] == 0
    assert (level[inner[:-1]] > level[binary.parent[inner[:-1]]]).all()
    others = np.setdiff1d(np.arange(len(level)), inner)
    assert (level[others] == -1).all()
    octaves = (binary.log_size[-1] - binary.log_size[inner]) / math.log(2)
    assert (level[inner] >= np.floor(prune.STEPS * octaves - 1e-3)).all()


@given(BINARIES, st.floats(0, 1))
def test_kept_nodes_become_a_valid_tree(binary: Binary, share: float) -> None:
    kept = binary.drop(max(1, int(share * (binary.leaves - 1))))
    order, tree, inner, places = binary.place()
    tree.validate()
    assert np.array_equal(np.sort(order), kept)
    assert order[0] == len(binary.size) - 1
    assert np.array_equal(order[places], inner)
    assert np.array_equal(tree.is_leaf, order < binary.leaves)
    for place, node in zip(places, inner, strict=True):
        start = int(tree.child_start[place])
        assert (binary.parent[order[start : start + int(tree.child_count[place])]] == node).all()
    assert np.array_equal(tree.child_start[places], np.sort(tree.child_start[places]))  # in the order of their parents


@given(BINARIES)
def test_with_nothing_dropped_the_tree_is_the_binary_one(binary: Binary) -> None:
    binary.drop(binary.leaves - 1)
    order, tree, inner, places = binary.place()
    assert len(order) == 2 * binary.leaves - 1
    for place, node in zip(places, inner, strict=True):
        start = int(tree.child_start[place])
        assert tree.child_count[place] == 2
        assert set(order[start : start + 2].tolist()) == set(binary.children[node].tolist())


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=2, max_size=30))
def test_sort_keys_have_the_order_of_their_values(values: list[float]) -> None:
    keys = [prune.usefulness_key(value) for value in sorted(values)]
    assert keys == sorted(keys)
    assert min(keys) >= 0 and max(keys) < 1 << prune.KEY_BITS
