"""What is kept of a binary tree, and the tree that it makes."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.lod import pair_tree
from sparklod_cli.lod.kernels import prune
from sparklod_cli.model.lod_tree import LodTree
from tests.references import pruning as references

#: Of a place in the order that nobody has taken.
UNUSED = np.uint32(0xFFFFFFFF)


class Binary:
    """A random binary tree as it has grown: leaves first, then nodes after their children."""

    def __init__(self, leaves: int, seed: int, equal: bool, blocks: int = 1) -> None:
        rng = np.random.default_rng(seed)
        total = 2 * leaves - 1
        self.leaves, self.blocks = leaves, blocks
        self.children = np.zeros((leaves - 1, 2), np.uint32)
        self.size = np.ones(total, np.float32)
        self.error = np.zeros(leaves - 1, np.float32)
        if not equal:
            self.size[:] = np.exp(rng.normal(0, 2, total))
            self.error[:] = rng.uniform(0, 1, leaves - 1)
        left = list(range(leaves))
        for node in range(leaves, total):
            for side in range(2):
                self.children[node - leaves, side] = left.pop(int(rng.integers(len(left))))
            left.append(node)
            if not equal and rng.random() < 0.8:  # mostly larger than their children
                self.size[node] = self.size[self.children[node - leaves]].max() * rng.uniform(1, 2)
        self.log_size, self.lost, self.weight = self.size.copy(), self.error.copy(), np.empty(leaves - 1, np.float32)
        self.saved = np.ones(leaves - 1, np.int32)
        terms = self.log_size, self.lost, self.weight
        self.parent = pair_tree.fill_usefulness_terms(self.children, leaves, leaves, total - 1, *terms, blocks)

    def drop(self, most: int) -> np.ndarray:
        """Drops; returns which are kept, leaves among them."""
        pair_tree.drop_nodes(
            self.leaves, most, self.parent, self.log_size, self.lost, self.weight, self.saved, self.blocks
        )
        return np.flatnonzero(self.is_kept)

    @property
    def is_kept(self) -> np.ndarray:
        """Of every node."""
        return np.concatenate([np.ones(self.leaves, bool), self.saved >= 0])

    def ranks(self) -> np.ndarray:
        """Of merged nodes."""
        highest, latest = self.log_size[-1], np.empty(0, np.int32)
        return prune.size_ranks(self.leaves, highest, self.parent, self.log_size, self.saved, latest)

    def place(self) -> tuple[np.ndarray, LodTree, np.ndarray, np.ndarray]:
        """The node of each final index, the tree, inner nodes and their places."""
        rank = self.ranks()
        inner = np.flatnonzero(rank != prune.NO_RANK).astype(np.uint32)
        inner = inner[np.argsort(rank[inner], kind="stable")] + np.uint32(self.leaves)
        total = self.leaves + len(inner)
        order = np.full(total, UNUSED)
        tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
        columns = order, tree.child_start, tree.child_count
        places = prune.lay_out_children(inner, self.leaves, self.parent, self.saved, *columns)
        return order, tree, inner, places


BINARIES = st.builds(Binary, st.integers(2, 150), st.integers(0, 2**32 - 1), st.booleans(), st.integers(1, 5))


@given(BINARIES)
def test_every_node_is_valued_below_its_parent(binary: Binary) -> None:
    total = len(binary.size)
    assert binary.parent[total - 1] == total - 1
    for node in range(binary.leaves, total):
        assert (binary.parent[binary.children[node - binary.leaves]] == node).all()
    expected = np.log(binary.size)
    for node in range(total - 2, -1, -1):
        expected[node] = min(expected[node], expected[binary.parent[node]])
    np.testing.assert_allclose(binary.log_size, expected, atol=1e-5)
    assert (binary.log_size <= binary.log_size[binary.parent]).all()
    assert (binary.weight > 0).all() and (binary.weight <= 1).all()
    assert np.isfinite(binary.lost).all() and (binary.lost >= 0).all()


@given(BINARIES, st.floats(0, 1))
def test_no_more_are_kept_than_asked_for_and_their_parents_are_nearest_of_them(binary: Binary, share: float) -> None:
    most = max(1, int(share * (binary.leaves - 1)))
    above = binary.parent.copy()
    kept = binary.drop(most)
    assert binary.saved[-1] > 0
    assert len(kept) - binary.leaves == min(most, binary.leaves - 1)  # neither more than wanted is dropped
    is_kept = binary.is_kept
    children = np.zeros(len(above), int)
    for node in kept[:-1]:
        nearest = above[node]
        while not is_kept[nearest]:
            nearest = above[nearest]
        assert binary.parent[node] == nearest
        children[nearest] += 1
    inner = kept[kept >= binary.leaves]
    assert np.array_equal(binary.saved[inner - binary.leaves] + 1, children[inner])


def test_the_most_useful_nodes_are_kept() -> None:
    """Of two inner nodes under a root, equal but for their errors, the one with less of it."""
    children = np.array([[0, 1], [2, 3], [4, 5]], np.uint32)
    for worse in (0, 1):
        log_size = np.array([1, 1, 1, 1, 2, 2, 8], np.float32)
        lost = np.array([0.1, 0.1, 1], np.float32)
        lost[worse] = 0.4
        weight, saved = np.empty(3, np.float32), np.ones(3, np.int32)
        parent = pair_tree.fill_usefulness_terms(children, 4, 4, 6, log_size, lost, weight, 2)
        pair_tree.drop_nodes(4, 2, parent, log_size, lost, weight, saved, 2)
        assert saved.tolist() == ([-1, 1, 2] if worse == 0 else [1, -1, 2])


@given(st.integers(2, 150), st.integers(0, 2**32 - 1), st.booleans(), st.integers(2, 9), st.floats(0, 1))
def test_the_number_of_blocks_changes_nothing(leaves: int, seed: int, equal: bool, blocks: int, share: float) -> None:
    one, many = (Binary(leaves, seed, equal, count) for count in (1, blocks))
    for name in ("log_size", "lost", "weight", "parent"):
        assert np.array_equal(getattr(one, name), getattr(many, name))
    most = max(1, int(share * (leaves - 1)))
    kept = one.drop(most)
    assert np.array_equal(kept, many.drop(most))
    assert np.array_equal(one.saved, many.saved) and np.array_equal(one.lost, many.lost)
    assert np.array_equal(one.parent[kept], many.parent[kept])


@given(BINARIES, st.integers(0, 150))
def test_it_drops_as_a_plain_loop_does(binary: Binary, most: int) -> None:
    """Which looks at every node in every round, and keeps no list."""
    most = max(most, 1)
    parent, lost, saved = binary.parent.copy(), binary.lost.copy(), binary.saved.copy()
    references.drop_nodes(binary.leaves, most, parent, binary.log_size, lost, binary.weight, saved)
    kept = binary.drop(most)
    assert np.array_equal(saved, binary.saved) and np.array_equal(lost, binary.lost)
    assert np.array_equal(parent[kept], binary.parent[kept])


@given(BINARIES, st.floats(0, 1))
def test_levels_rise_along_every_path(binary: Binary, share: float) -> None:
    kept = binary.drop(max(1, int(share * (binary.leaves - 1))))
    rank = binary.ranks()
    inner = kept[kept >= binary.leaves] - binary.leaves
    assert rank[inner[-1]] == 0
    assert (rank[inner[:-1]] > rank[binary.parent[inner[:-1] + binary.leaves] - binary.leaves]).all()
    assert np.array_equal(np.flatnonzero(rank != prune.NO_RANK), inner)
    octaves = (binary.log_size[-1] - binary.log_size[inner + binary.leaves]) / math.log(2)
    assert (rank[inner] >= np.floor(prune.STEPS * octaves - 1e-3)).all()


@given(BINARIES, st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_ranks_are_below_those_that_leaves_have_already(binary: Binary, share: float, seed: int) -> None:
    binary.drop(max(1, int(share * (binary.leaves - 1))))
    latest = np.random.default_rng(seed).integers(-20, 20, binary.leaves).astype(np.int32)
    terms = binary.leaves, np.float32(3), binary.parent, binary.log_size, binary.saved
    free, bound = (prune.size_ranks(*terms, ranks) for ranks in (latest[:0], latest))
    assert (bound <= free).all()
    rank = np.concatenate([latest, bound])
    for node in np.flatnonzero(binary.is_kept)[:-1]:
        assert rank[node] > rank[binary.parent[node]]


@given(BINARIES, st.integers(0, 150), st.integers(0, 100))
def test_of_nodes_that_get_their_parents_later_as_many_are_dropped(binary: Binary, cut: int, most: int) -> None:
    """The last merges are undone: what they merged is without a parent."""
    total = max(2 * binary.leaves - 1 - cut, binary.leaves)
    made = total - binary.leaves
    children = binary.children[:made]
    log_size, lost = np.append(binary.size[:total], np.float32(0)), np.ones(made + 1, np.float32)
    weight = np.empty(made + 1, np.float32)
    parent = pair_tree.fill_usefulness_terms(children, binary.leaves, binary.leaves, total, log_size, lost, weight, 2)
    loose = np.setdiff1d(np.arange(total), children)
    assert np.array_equal(np.flatnonzero(parent[:-1] == total), loose)
    saved = np.ones(made + 1, np.int32)
    saved[-1] = len(loose) - 1 - prune.ROOM
    pair_tree.drop_nodes(binary.leaves, most + 1, parent, log_size, lost, weight, saved, 2)
    assert np.count_nonzero(saved[:-1] >= 0) == min(most, made)
    kept = np.concatenate([np.ones(binary.leaves, bool), saved[:-1] >= 0])
    assert saved[-1] + prune.ROOM + 1 == np.count_nonzero((parent[:-1] == total) & kept)


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
        assert set(order[start : start + 2].tolist()) == set(binary.children[node - binary.leaves].tolist())


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=2, max_size=30))
def test_sort_keys_have_the_order_of_their_values(values: list[float]) -> None:
    keys = [prune.usefulness_key(value) for value in sorted(values)]
    assert keys == sorted(keys)
    assert min(keys) >= 0 and max(keys) < 1 << prune.KEY_BITS
