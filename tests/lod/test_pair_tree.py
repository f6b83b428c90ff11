"""Node rows, their order along curves, the nodes that are kept of a binary tree, and the tree that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparklod_cli.lod import quality
from sparklod_cli.lod.kernels import geometry, node_rows, pair_merge, prune
from sparklod_cli.lod.kernels.geometry import SplatColumns
from sparklod_cli.lod.kernels.node_rows import merge_colors
from sparklod_cli.lod.kernels.pair_merge import CENTER, COLOR, COVERED, DENSITY, WEIGHT, WIDTH
from sparklod_cli.lod.kernels.sort import AXIS_BITS, PART_BITS, Parts, sort_by_cell, sort_by_key, split_box, spread_bits
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.lod_tree import LodTree
from tests.references import gaussians
from tests.references import quality as twin
from tests.scenes import random_splats


def morton(cell: Sequence[int]) -> int:
    """The place of a cell along a Morton curve."""
    return sum(((int(axis) >> bit) & 1) << (3 * bit + k) for k, axis in enumerate(cell) for bit in range(64))


# Node rows


def test_rows_of_leaves_are_their_splats_in_units() -> None:
    splats = random_splats(100, seed=9)
    index = np.random.default_rng(1).permutation(100).astype(np.uint32)
    rows = np.zeros((120, pair_merge.WIDTH), np.float32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    columns = SplatColumns(splats.center, splats.scale, splats.quat_xyzw, splats.opacity)
    size = np.zeros(120, np.float32)
    node_rows.fill_leaf_rows(100, index, columns, splats.rgb, node_rows.Space(middle, unit), rows, size)
    assert not rows[100:].any() and not size[100:].any()
    np.testing.assert_allclose(size[:100] * unit, spark_size(splats)[index], rtol=1e-5)
    for row, i in zip(rows, index, strict=False):
        np.testing.assert_allclose(row[CENTER : CENTER + 3] * unit + middle, splats.center[i], atol=1e-5)
        covariance = gaussians.covariance(splats.scale[i], splats.quat_xyzw[i]) / unit**2
        np.testing.assert_allclose(twin.matrix(row), covariance, atol=1e-5 * np.trace(covariance))
        area = gaussians.ellipsoid_area(splats.scale[i]) / unit**2
        assert row[COVERED] == row[WEIGHT] == pytest.approx(splats.opacity[i] * area, rel=1e-5)
        assert row[DENSITY] == splats.opacity[i]
        assert np.array_equal(row[COLOR : COLOR + 3], splats.rgb[i])


def test_merged_nodes_are_drawn_with_the_variance_and_coverage_of_their_rows() -> None:
    rows = twin.random_rows(100, seed=10)
    rows[:, DENSITY] = np.geomspace(0.01, 5, 100)
    order = np.random.default_rng(2).permutation(100).astype(np.uint32)
    middle, unit = np.array([0.5, -1.0, 2.0]), 2.0**-6
    out = random_splats(100, seed=11)
    before = out.take(np.arange(100))
    space, columns = node_rows.Space(middle, unit), (out.center, out.scale, out.quat_xyzw, out.opacity)
    row = np.random.default_rng(3).permutation(60).astype(np.uint32)  # of nodes 40 to 99
    node_rows.fill_merged_splats(100, order, 40, row, rows, space, *columns)
    for i, node in enumerate(order):
        if node < 40:  # a leaf
            assert np.array_equal(out.center[i], before.center[i])
            assert out.opacity[i] == before.opacity[i]
            continue
        drawn = rows[row[node - 40]]
        np.testing.assert_allclose(out.center[i], drawn[CENTER : CENTER + 3] * unit + middle, rtol=1e-5)
        opacity, spread = geometry.profile_of(
            float(drawn[DENSITY]), geometry.is_needle(*np.linalg.eigvalsh(twin.matrix(drawn)))
        )
        assert out.opacity[i] == pytest.approx(opacity)
        covariance = twin.matrix(drawn) * unit**2 / spread
        got = gaussians.covariance(out.scale[i], out.quat_xyzw[i])
        np.testing.assert_allclose(got, covariance, atol=1e-5 * np.trace(covariance))


def test_keys_are_places_on_a_morton_curve_and_what_is_outside_is_at_its_edge() -> None:
    rows = twin.random_rows(100, seed=12)
    low, step = np.array([-1.0, -1.5, -2.0]), 1e-3
    nodes = np.arange(100, dtype=np.uint32)[::-1].copy()
    most = (1 << node_rows.CURVE_BITS) - 1
    cells = np.clip((rows[nodes, CENTER : CENTER + 3].astype(np.float64) - low) / step, 0, most).astype(int)
    keys = np.empty(100, np.uint64)
    node_rows.fill_morton_keys(100, rows, nodes, low, step, keys)
    assert keys.tolist() == list(map(morton, cells))


def test_colours_are_weighted_means_of_children() -> None:
    rng = np.random.default_rng(3)
    color, weight = rng.normal(size=(9, 5)).astype(np.float32), rng.uniform(0.1, 2, 9)
    order = rng.permutation(9).astype(np.uint32)
    start, count = np.array([1, 4, 0, 6, 0, 0, 0, 0, 0], np.uint32), np.array([3, 2, 0, 3, 0, 0, 0, 0, 0], np.uint16)
    expected = color.copy()
    for node in (1, 3):
        part = slice(start[node], start[node] + count[node])
        expected[node] = np.average(color[part].astype(np.float64), axis=0, weights=weight[order[part]])
    merge_colors(2, np.array([1, 3], np.uint32), start, count, order, weight, color)
    assert np.allclose(color, expected, atol=1e-6)


# Sorting


@given(
    arrays(np.uint64, st.integers(1, 300), elements=st.integers(0, 2**64 - 1)), st.integers(1, 64), st.integers(1, 5)
)
def test_sorting_is_stable_and_the_same_in_any_number_of_pieces(keys: np.ndarray, bits: int, chunks: int) -> None:
    keys = (keys >> np.uint64(64 - bits)) // np.uint64(3) * np.uint64(3)  # with ties
    expected = np.argsort(keys, kind="stable")
    got_keys, got = sort_by_key(keys.copy(), np.arange(len(keys), dtype=np.uint32), bits, chunks)
    assert np.array_equal(got, expected)
    assert np.array_equal(got_keys, keys[expected])


@given(st.integers(0, 2**21 - 1))
def test_bits_are_spread_by_three(x: int) -> None:
    assert spread_bits(np.uint64(x)) == morton((x, 0, 0))


@pytest.mark.parametrize("within", [True, False])
@pytest.mark.parametrize("span", [3, 1000, 2**20, 2**23])  # up to two words of 21 bits
def test_cells_come_in_morton_order_and_are_told_apart(span: int, within: bool) -> None:
    rng = np.random.default_rng(span)
    step = 2.0**-6
    parts = rng.integers(0, span, (40, 3))[rng.integers(40, size=300)]
    geometry = np.zeros((300, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = (parts - span // 2 + 0.5) * step
    nodes = rng.permutation(300).astype(np.uint32)
    bits = int(span - 1).bit_length()
    grid = Parts(np.float64(step), np.array([-(span // 2)] * 3), bits, -(-bits // AXIS_BITS))
    got, is_first = sort_by_cell(geometry, nodes, grid, 2, within=within)
    cells = parts >> PART_BITS
    codes = [morton((parts if within else cells)[node]) for node in nodes]
    expected = nodes[np.array(sorted(range(300), key=lambda i: codes[i]))]
    assert np.array_equal(got, expected)
    changes = (cells[got][1:] != cells[got][:-1]).any(axis=1)
    assert np.array_equal(is_first, np.concatenate([[True], changes]))


def test_nodes_are_split_by_a_box_without_its_faces() -> None:
    axis = np.float32([-1, 0, 1, 2])
    geometry = np.zeros((64, WIDTH), np.float32)
    geometry[:, CENTER : CENTER + 3] = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    nodes = np.random.default_rng(0).permutation(64).astype(np.uint32)
    below, above = np.float32([-1, -np.inf, 0]), np.float32([2, 1, np.inf])
    inside, outside = split_box(nodes, geometry, below, above)
    center = geometry[nodes, CENTER : CENTER + 3]
    expected = ((center > below) & (center < above)).all(axis=1)
    assert inside.tolist() == nodes[expected].tolist()
    assert outside.tolist() == nodes[~expected].tolist()
    assert 0 < len(inside) < 64


# Pruning

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
        self.parent = quality.fill_usefulness_terms(self.children, leaves, leaves, total - 1, *terms, blocks)

    def drop(self, most: int) -> np.ndarray:
        """Drops; returns which are kept, leaves among them."""
        quality.drop_nodes(
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
        rank = np.empty(len(self.saved), np.int32)
        prune.fill_size_ranks(self.leaves, highest, self.parent, self.log_size, self.saved, latest, rank)
        return rank

    def place(self) -> tuple[np.ndarray, LodTree, np.ndarray, np.ndarray]:
        """The node of each final index, the tree, inner nodes and their places."""
        rank = self.ranks()
        inner = np.flatnonzero(rank != prune.NO_RANK).astype(np.uint32)
        inner = inner[np.argsort(rank[inner], kind="stable")] + np.uint32(self.leaves)
        total = self.leaves + len(inner)
        order = np.full(total, UNUSED)
        tree = LodTree(np.zeros(total, np.uint16), np.zeros(total, np.uint32))
        places = np.empty(len(inner), np.uint32)
        columns = order, tree.child_start, tree.child_count, places
        prune.lay_out_children(inner, self.leaves, self.parent, self.saved, *columns)
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
    twin.drop_nodes(binary.leaves, most, parent, binary.log_size, lost, binary.weight, saved)
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
    free, bound = np.empty((2, len(binary.saved)), np.int32)
    prune.fill_size_ranks(*terms, latest[:0], free)
    prune.fill_size_ranks(*terms, latest, bound)
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
    parent = quality.fill_usefulness_terms(children, binary.leaves, binary.leaves, total, log_size, lost, weight, 2)
    loose = np.setdiff1d(np.arange(total), children)
    assert np.array_equal(np.flatnonzero(parent[:-1] == total), loose)
    saved = np.ones(made + 1, np.int32)
    saved[-1] = len(loose) - 1 - prune.ROOM
    quality.drop_nodes(binary.leaves, most + 1, parent, log_size, lost, weight, saved, 2)
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
